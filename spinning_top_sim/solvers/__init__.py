# SPDX-License-Identifier: Apache-2.0
"""
How a state moves in time.  numpy and gmpy2 at most; no ROS, no I/O.

A solver makes a `motion`, which `solve` chooses and reads; `handover` has the pieces of a run,
about the `vertical` of each.  Exact: `constants` of a motion, in `theta` functions, which
`evaluate` takes to many times and `exact` makes states of.  Steps: `dormand_prince`, of either
form of the `equations`.
"""
