# SPDX-License-Identifier: Apache-2.0
"""
Self-contained MCAP logs: finding message definitions, writing with bounded loss.

Here belongs what turns (topic, stamp, CDR bytes) into files and back.  What never does: rclpy, a
clock of the simulation, the content of a message, physics.  mcap and its compressors are imported
when a recording starts, not before.
"""
