/* Calls the exported damper for many points at once. */
#include "mr_damper.h"

void law(const double *inputs, long count, double *coefficients, double *force) {
  long k;
  int c;
  for (k = 0; k < count; ++k) {
    mr_damper_point point = {0};
    mr_damper_result result;
    point.velocity = inputs[5 * k];
    point.peak_velocity = inputs[5 * k + 1];
    point.branch = inputs[5 * k + 3];
    point.change = inputs[5 * k + 4];
    mr_damper_law(&point, inputs[5 * k + 2], &result);
    for (c = 0; c < 7; ++c) coefficients[7 * k + c] = result.coefficients[c];
    force[k] = result.plain;
  }
}

void inverse(const double *inputs, const double *wanted, long count, double *current,
             double *force) {
  long k;
  for (k = 0; k < count; ++k) {
    mr_damper_point point = {0};
    point.velocity = inputs[5 * k];
    point.peak_velocity = inputs[5 * k + 1];
    point.branch = inputs[5 * k + 3];
    point.change = inputs[5 * k + 4];
    current[k] = mr_damper_current(&point, wanted[k], &force[k]);
  }
}

void stream(const double *displacement, const double *current, long count, double centre,
            double *force) {
  long k;
  mr_damper_state damper;
  mr_damper_reset(&damper, centre);
  for (k = 0; k < count; ++k) {
    mr_damper_supply(&damper, current[k]);
    force[k] = mr_damper_step(&damper, displacement[k]);
  }
}
