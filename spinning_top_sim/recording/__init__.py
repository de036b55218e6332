# SPDX-License-Identifier: Apache-2.0
"""
MCAP logs: what turns (topic, stamp, CDR bytes) into files and back.

`recorder` records while a simulation runs, with `mcap_writer` and `chunks`.  `reader` opens a log:
`log_file` reads its bytes and its summary, `parsing` decodes, `scan` finds what is left of a
damaged file, and `recovery` writes that anew.

What never belongs here: rclpy, a clock of the simulation, the content of a message, physics.
"""
