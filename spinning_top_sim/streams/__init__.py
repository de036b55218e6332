# SPDX-License-Identifier: Apache-2.0
"""What is said about a state: topics, rates, and how states become CDR bytes.  No ROS needed."""
