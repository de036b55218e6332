# SPDX-License-Identifier: Apache-2.0
"""
Elliptic integrals by Gauss' arithmetic-geometric mean, in multiprecision.

One sequence of means of a_0 and g_0 gives the complete integral of the first kind and the nome,
and, with one more square root a step, an incomplete integral.
No step subtracts numbers of one size, and all converge quadratically.

    a_(n+1) = (a_n + g_n)/2,  g_(n+1) = sqrt(a_n g_n),  c_n = sqrt(a_n^2 - g_n^2)    [DLMF 19.8(i)]

The modulus is k = c_0/a_0, its complement k' = g_0/a_0.  The arguments a_0, g_0, c_0 need no
common scale: the functions depend on their ratios only, but for the mean itself.
"""

from gmpy2 import mpfr, sqrt

from spinning_top_sim.solvers.multiprecision import ONE, ZERO

# Coefficients of lambda, lambda^5, lambda^9 ... in the nome [DLMF 19.5.6; A002103 of oeis.org].
# The first one that is left out contributes less than 1e-44 for k^2 <= 1/2.
NOME_COEFFICIENTS = 1, 2, 15, 150, 1707, 20910, 268616, 3567400, 48555069, 673458874
NEGLIGIBLE = 1e-21      # a ratio whose square does not count


class GaussMean:
    """
    The arithmetic-geometric mean M of a_0 and g_0; the caller knows c_0 without cancellation.

    mean : M; the quarter period K(k) is (pi/2) a_0/M [DLMF 19.8.5]
    """

    def __init__(self, a: mpfr, g: mpfr, c: mpfr) -> None:
        self._start, self._squares = a, [c * c]
        self._means: list[tuple[mpfr, mpfr]] = []     # g_n and c_n
        while not self._means or c > a * NEGLIGIBLE:
            product, a = a * g, (a + g) / 2
            c = self._squares[-1] / (4 * a)         # [DLMF 19.8.3]
            g = sqrt(product) if c > a * NEGLIGIBLE else a
            self._means.append((g, c))
            self._squares.append(c * c)
        self.mean = a

    @property
    def quarter_period(self) -> mpfr:
        """2 K(k)/pi."""
        return self._start / self.mean

    def nome(self) -> mpfr:
        """Return q = exp(-pi K'/K) to 40 digits, for k^2 <= 1/2."""
        a, (g, c) = self._start, self._means[0]
        small = a * c / (a + g) ** 2                # (1 - sqrt(k'))/(1 + sqrt(k'))/2
        power, total = small ** 4, ZERO
        for coefficient in reversed(NOME_COEFFICIENTS):
            total = total * power + coefficient
        return small * total

    def amplitude(self, square: mpfr, sign: int) -> mpfr:
        """
        Return sin(pi u/(2K)) from sn^2(u), or sinh(pi u/(2K)) from -sn^2(iu).

        By descending Gauss transformations [DLMF 19.8.18], which leave u/K as it is and end at
        k = 0.  In terms of h = a/sin or a/sinh of the amplitude a step is a mean too.

        square : sn^2(u) in [0, 1] with sign -1; -sn^2(iu) >= 0 with sign 1
        """
        if not square:
            return ZERO
        h = self._start / sqrt(square)
        for c2 in self._squares:
            # Two terms of the root are enough where c is small.
            h2 = h * h
            h = (h + sign * c2 / (4 * h) if c2 < h2 * NEGLIGIBLE
                 else (h + sqrt(h2 + sign * c2)) / 2)
        amplitude = self.mean / h
        # The square may be 1 but for rounding: the sine is then 1.
        return min(amplitude, ONE) if sign < 0 else amplitude
