# SPDX-License-Identifier: Apache-2.0
"""The ROS side, thin: parameters, timers, services, publishers.  What moves is elsewhere."""
