# SPDX-License-Identifier: Apache-2.0
"""
MCAP logs: what turns (topic, stamp, CDR bytes) into files and back.

`recorder` records while a simulation runs, with `writer`.  `reader` opens a log, also a damaged
one, and recovers it.  `rosbag2` and `provenance` have the metadata.

What never belongs here: rclpy, a clock of the simulation, the content of a message, physics.
"""
