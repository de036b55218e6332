# SPDX-License-Identifier: Apache-2.0
"""The top itself: constants, states, attitude mathematics, regimes.  No ROS, no I/O."""
