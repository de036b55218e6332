# SPDX-License-Identifier: Apache-2.0
"""The command line without ROS: simulate, and what is done with a log."""
