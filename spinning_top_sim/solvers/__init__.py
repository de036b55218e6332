# SPDX-License-Identifier: Apache-2.0
"""
How a state moves in time.  numpy and gmpy2 at most; no ROS, no I/O.

`propagator` chooses among the methods, and has `solve`.

The closed form: `theta_setup` finds the constants of a motion in `multiprecision`, by the
roots of a cubic (`cubic`), their elliptic integrals (`elliptic`) and series of theta functions
(`theta_series`).  `theta_values` evaluates these at many `times` in doubles, `exact` makes states
of them, and `vertical` joins such motions where the pivot accelerates.

Steps: `dormand_prince` is the method, `transport` and `euler` are equations for it.
"""
