# SPDX-License-Identifier: Apache-2.0
"""What random inputs and faults must not break.  `python test/stress --help` tells the parts."""
