# SPDX-License-Identifier: Apache-2.0
"""Numbers that are extreme and look legal."""

import math
import sys

DOUBLES = (0.0, -0.0, 5e-324, 1e-310, 1e-300, 1e-170, 1e-100, 1e-46, 1e-20, 1e-9, 1e-3, 0.5, 1.0,
           math.pi, 2.0, 14.0, 1e3, 1e5, 1e9, 1e10, 1e16, 1e17, 1e20, 1e30, 1e100, 1e154, 1e200,
           1e300, sys.float_info.max)
