# SPDX-License-Identifier: Apache-2.0
"""The nodes: parameters, timers, services and publishers around a simulation or a log."""
