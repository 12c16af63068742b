/* Inputs of a step at its start, its middle and its end, controls before disturbances. */
typedef double NAME_stages[3][UPPER_CONTROLS + UPPER_DISTURBANCES + 1];

static int NAME_rk4(double seconds, const double *states, NAME_stages inputs,
    const double *parameters, double *next) {
  double k[4][UPPER_STATES], x[UPPER_STATES];
  static const int places[4] = {0, 1, 1, 2};
  int i, s;
  for (s = 0; s < 4; ++s) {
    const double *u = inputs[places[s]];
    for (i = 0; i < UPPER_STATES; ++i) {
      x[i] = s ? states[i] + 0.5 * places[s] * seconds * k[s - 1][i] : states[i];
    }
    if (NAME_derivative(x, u, u + UPPER_CONTROLS, parameters, k[s])) return 1;
  }
  for (i = 0; i < UPPER_STATES; ++i) {
    next[i] = states[i] + seconds / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
  }
  return 0;
}

int NAME_step(double seconds, const double *states,
    const double *controls_start, const double *disturbances_start,
    const double *controls_end, const double *disturbances_end,
    const double *parameters, double *next) {
  NAME_stages inputs;
  int i, s;
  for (s = 0; s < 3; ++s) {
    const double share = 0.5 * s;
    for (i = 0; i < UPPER_CONTROLS; ++i) {
      inputs[s][i] = (1.0 - share) * controls_start[i] + share * controls_end[i];
    }
    for (i = 0; i < UPPER_DISTURBANCES; ++i) {
      inputs[s][UPPER_CONTROLS + i] =
          (1.0 - share) * disturbances_start[i] + share * disturbances_end[i];
    }
  }
  return NAME_rk4(seconds, states, inputs, parameters, next);
}

/* An input at a sample, by its place among controls and disturbances. */
static double NAME_sample(const double *controls, const double *disturbances, int k, int i) {
  return i < UPPER_CONTROLS ? controls[(size_t)k * UPPER_CONTROLS + i]
                            : disturbances[(size_t)k * UPPER_DISTURBANCES + i - UPPER_CONTROLS];
}

/* Slopes of a spline through v at n times: no knots at the second and at the last but one. */
static void NAME_slopes(int n, const double *t, const double *v, double *slope, double *pivot) {
  int i, end;
  for (end = 0; end < 2; ++end) {
    const int first = end ? n - 1 : 0, by = end ? -1 : 1;
    const double a = by * (t[first + by] - t[first]);
    const double b = by * (t[first + 2 * by] - t[first + by]);
    const double p = by * (v[first + by] - v[first]) / a;
    const double q = by * (v[first + 2 * by] - v[first + by]) / b;
    pivot[first] = b;
    slope[first] = ((3.0 * a + 2.0 * b) * b * p + a * a * q) / (a + b);
  }
  for (i = 1; i < n; ++i) {
    const double h = t[i] - t[i - 1], high = i == 1 ? t[2] - t[0] : t[i - 1] - t[i - 2];
    const double low = i == n - 1 ? t[n - 1] - t[n - 3] : t[i + 1] - t[i];
    const double share = low / pivot[i - 1];
    if (i < n - 1) {
      pivot[i] = 2.0 * (h + low);
      slope[i] = 3.0 * (low * (v[i] - v[i - 1]) / h + h * (v[i + 1] - v[i]) / low);
    }
    pivot[i] -= share * high;
    slope[i] -= share * slope[i - 1];
  }
  slope[n - 1] /= pivot[n - 1];
  for (i = n - 2; i >= 0; --i) {
    const double high = i ? t[i] - t[i - 1] : t[2] - t[0];
    slope[i] = (slope[i] - high * slope[i + 1]) / pivot[i];
  }
}

int NAME_simulate(int samples, const double *time, const double *controls,
    const double *disturbances, const double *parameters, double *states) {
  enum { INPUTS = UPPER_CONTROLS + UPPER_DISTURBANCES };
  double *slopes = 0, *room = 0, longest = 0.0, shortest = 0.0;
  int failed = 0, smooth = 0, steps = 1, i, j, k, s;
  for (k = 1; k < samples; ++k) {
    const double h = time[k] - time[k - 1];
    if (!(h >= 0.0)) return 2;
    longest = h > longest ? h : longest;
    shortest = k == 1 || h < shortest ? h : shortest;
  }
  if (NAME_longest_step > 0.0 && longest / NAME_longest_step * (1.0 - 1e-9) > 1.0) {
    const double count = longest / NAME_longest_step * (1.0 - 1e-9);
    if (!(count < 1e9)) return 2;
    steps = (int)count + (count > (int)count);
  }
  for (i = 0; i < INPUTS; ++i) smooth += NAME_between[i] == 2;
  if (smooth && samples > 1) {
    const double mean = (time[samples - 1] - time[0]) / (samples - 1);
    if (samples < 4 || !(shortest > 1e-6 * mean)) return 2;
    slopes = (double *)malloc(sizeof(double) * (size_t)samples * (INPUTS + 2));
    if (!slopes) return 3;
    room = slopes + (size_t)samples * INPUTS;
    for (i = 0; i < INPUTS; ++i) {
      if (NAME_between[i] != 2) continue;
      for (k = 0; k < samples; ++k) room[k] = NAME_sample(controls, disturbances, k, i);
      NAME_slopes(samples, time, room, slopes + (size_t)samples * i, room + samples);
    }
  }
  for (k = 0; k + 1 < samples && !failed; ++k) {
    const double h = time[k + 1] - time[k], part = h / steps;
    double *x = states + (size_t)k * UPPER_STATES, *next = x + UPPER_STATES;
    for (i = 0; i < UPPER_STATES; ++i) next[i] = x[i];
    for (j = 0; j < steps && h > 0.0 && !failed; ++j) {
      NAME_stages inputs;
      for (i = 0; i < INPUTS; ++i) {
        const double begin = NAME_sample(controls, disturbances, k, i);
        const double rise = (NAME_sample(controls, disturbances, k + 1, i) - begin) / h;
        const double *m = slopes ? slopes + (size_t)samples * i + k : 0;
        for (s = 0; s < 3; ++s) {
          const double t = part * (j + 0.5 * s);
          if (NAME_between[i] == 0) inputs[s][i] = begin;
          if (NAME_between[i] == 1) inputs[s][i] = begin + t * rise;
          if (NAME_between[i] == 2) {
            const double bend = (3.0 * rise - 2.0 * m[0] - m[1]) / h;
            const double twist = (m[0] + m[1] - 2.0 * rise) / (h * h);
            inputs[s][i] = begin + t * (m[0] + t * (bend + t * twist));
          }
        }
      }
      failed = NAME_rk4(part, next, inputs, parameters, next);
    }
  }
  free(slopes);
  return failed;
}
