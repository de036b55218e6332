# SPDX-License-Identifier: Apache-2.0
"""
MCAP logs: what turns (topic, stamp, CDR bytes) into files and back.

What never belongs here: rclpy, a clock of the simulation, the content of a message, physics.
mcap and its compressors are imported when a recording starts, not before.
"""
