/* SPDX-License-Identifier: Apache-2.0 */
/* An attitude filter for `spinning-top examine --command ./filter`, which finds no fault:
   cc -O2 -o filter examples/filter.c -lm */
#include <math.h>
#include <stdio.h>

int main(void) {
    double gx, gy, gz, ax, ay, az, mx, my, mz, dt, w = 1, x = 0, y = 0, z = 0;
    while (scanf("%lf%lf%lf%lf%lf%lf%lf%lf%lf%lf", &gx, &gy, &gz, &ax, &ay, &az,
                 &mx, &my, &mz, &dt) == 10) {
        double ux = 2 * (x * z - w * y), uy = 2 * (y * z + w * x), uz = 1 - 2 * (x * x + y * y);
        double n = 2 * sqrt(ax * ax + ay * ay + az * az);       /* gain: 0.5 per second */
        double p = gx + (ay * uz - az * uy) / n, q = gy + (az * ux - ax * uz) / n;
        double r = gz + (ax * uy - ay * ux) / n, s = sqrt(p * p + q * q + r * r);
        double c = cos(s * dt / 2), k = s > 0 ? sin(s * dt / 2) / s : 0;
        double W = c * w - k * (x * p + y * q + z * r), X = c * x + k * (w * p + y * r - z * q);
        double Y = c * y + k * (w * q + z * p - x * r), Z = c * z + k * (w * r + x * q - y * p);
        w = W, x = X, y = Y, z = Z;
        printf("%.17g %.17g %.17g %.17g\n", x, y, z, w);
        fflush(stdout);
    }
}
