# SPDX-License-Identifier: Apache-2.0
"""Columns of complex numbers with the arithmetic of Python's own, to the last bit."""

from __future__ import annotations

from typing import Any


class Pairs:
    """
    Complex numbers as two columns of real ones, for the formulas of `attitude`.

    numpy multiplies its complex columns with fused instructions where the processor has them, and
    rounds otherwise than Python.  Real columns are added and multiplied alike everywhere, so what
    comes out does not depend on how many numbers there are, nor on where one of them stands.  (A
    Python that was compiled to fuse its own complex products, as compilers for ARM do unasked, has
    other last bits than these.)

    real, imag: (n,) columns;  operands are `Pairs`, real columns and real numbers
    """

    __slots__ = ('imag', 'real')

    # Has numpy leave `column * pairs` to `__rmul__`.
    __array_ufunc__ = None

    def __init__(self, real: Any, imag: Any) -> None:
        self.real, self.imag = real, imag

    def conjugate(self) -> Pairs:
        """Return the conjugates."""
        return Pairs(self.real, -self.imag)

    def __neg__(self) -> Pairs:
        return Pairs(-self.real, -self.imag)

    def __add__(self, other: Pairs) -> Pairs:
        return Pairs(self.real + other.real, self.imag + other.imag)

    def __sub__(self, other: Pairs) -> Pairs:
        return Pairs(self.real - other.real, self.imag - other.imag)

    def __mul__(self, other: Any) -> Pairs:
        if isinstance(other, Pairs):
            return Pairs(self.real * other.real - self.imag * other.imag,
                         self.real * other.imag + self.imag * other.real)
        return Pairs(self.real * other, self.imag * other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Pairs:
        return Pairs(self.real / other, self.imag / other)
