# SPDX-License-Identifier: Apache-2.0
"""How a state moves in time, a file per method.  numpy at most; no ROS, no I/O."""
