# SPDX-License-Identifier: Apache-2.0
"""How a state of the top moves in time: one protocol, a file per method."""
