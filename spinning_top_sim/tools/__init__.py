# SPDX-License-Identifier: Apache-2.0
"""The commands that need no ROS, and what they share."""
