# SPDX-License-Identifier: Apache-2.0
"""
The command line: arguments, progress, a report, an exit code.

Here belongs what a terminal needs.  What never does: what a test or another program would call,
and rclpy.
"""
