/* What both versions of FMI share: an instance of the model and what happens to it.

   All variables stand in one array. A value reference is a place in it: time, states, derivatives,
   controls, disturbances, field, parameters, step, outputs, distance from the training data.
   The last state is the azimuth where blades pass. No name here may begin as those do that the
   model's header has for its own: a name in capitals, an underscore and the name of a vector. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif

#define STRAYED "the training data are left: training_distance, an output, is above 1"

/* A version of FMI defines FMI(name), which puts its prefix before a name, and told(), which hands
   an error on. The first word of every function, and its last one: a problem in words, or NULL. */
#define SELF Instance *m = (Instance *)c; if (!m) return FMI(Error)
#define ANSWER(problem) \
  const char *text = (problem); \
  return text ? told(m, FMI(Error), text) : FMI(OK)

enum {
  AT__STATES = 1,
  AT__RATES = AT__STATES + COUNT__STATES,
  AT__INPUTS = AT__RATES + COUNT__STATES,
  COUNT__INPUTS = COUNT__CONTROLS + COUNT__DISTURBANCES + COUNT__FIELD,
  AT__FIELD = AT__INPUTS + COUNT__CONTROLS + COUNT__DISTURBANCES,
  AT__PARAMETERS = AT__INPUTS + COUNT__INPUTS,
  AT__STEP = AT__PARAMETERS + COUNT__PARAMETERS,
  AT__OUTPUTS = AT__STEP + 1,
  AT__DISTANCE = AT__OUTPUTS + COUNT__OUTPUTS,
  COUNT__ALL = AT__DISTANCE + 1
};

typedef struct {
  double value[COUNT__ALL];
  double slope[3][COUNT__INPUTS + 1]; /* derivatives of the inputs within a step, FMI 2 only */
  int stale; /* whether derivatives and outputs are to be computed */
} State;

/* Asks the importer for inputs at a time within a step; 0 where that was in vain. FMI 3 only. */
typedef struct Instance Instance;
typedef int (*Asker)(Instance *, double);
/* Any function of the importer; it is called as what it is. */
typedef void (*Function)(void);

struct Instance {
  State now;
  char name[256];
  void *environment;
  Function logger;
  Asker ask;
  Function update; /* what `ask` calls */
  int within; /* whether a step is being made: only inputs that are not held can be set */
  int refused; /* whether something could not be set */
  int logging;
  int strayed; /* whether it was told that the training data were left */
};

static void instance_reset(Instance *m) {
  memset(&m->now, 0, sizeof m->now);
  memcpy(m->now.value, start_values, sizeof m->now.value);
  m->now.stale = 1;
  m->strayed = 0;
}

static Instance *instance_new(const char *name) {
  Instance *m = (Instance *)calloc(1, sizeof *m);
  if (!m) return NULL;
  if (name) strncpy(m->name, name, sizeof m->name - 1);
  instance_reset(m);
  return m;
}

/* Derivatives of all states, the azimuth among them, at some states and inputs. */
static int rates(const double *p, const double *x, const double *inputs, double *dx) {
  int failed = MODEL_DERIVATIVE(x, inputs, inputs + COUNT__CONTROLS, p, dx);
#if TURNS
  dx[COUNT__STATES - 1] = RADIANS * x[SPEED];
#endif
  return failed;
}

static int update(Instance *m) {
  double *v = m->now.value;
  int failed;
  if (!m->now.stale) return 0;
  failed = rates(v + AT__PARAMETERS, v + AT__STATES, v + AT__INPUTS, v + AT__RATES);
#if TURNS
  failed |= MODEL_OUTPUT(v + AT__STATES, v + AT__INPUTS, v + AT__INPUTS + COUNT__CONTROLS,
      v + AT__PARAMETERS, v[AT__STATES + COUNT__STATES - 1], v + AT__FIELD, v + AT__OUTPUTS);
#else
  failed |= MODEL_OUTPUT(v + AT__STATES, v + AT__INPUTS, v + AT__INPUTS + COUNT__CONTROLS,
      v + AT__PARAMETERS, v + AT__OUTPUTS);
#endif
  m->now.stale = failed;
  return failed;
}

static int get_value(Instance *m, unsigned int reference, double *value) {
  double *v = m->now.value;
  if (reference >= COUNT__ALL) return 1;
  if (reference == AT__DISTANCE) {
    return MODEL_DISTANCE(v + AT__STATES, v + AT__INPUTS, v + AT__INPUTS + COUNT__CONTROLS,
        v + AT__PARAMETERS, value);
  }
  if ((reference >= AT__RATES && reference < AT__INPUTS) || reference >= AT__OUTPUTS) {
    if (update(m)) return 1;
  }
  *value = m->now.value[reference];
  return 0;
}

/* Why it cannot be set, or NULL; a step in which that happens is not made. */
static const char *set_value(Instance *m, unsigned int reference, double value) {
  const int is_state = reference >= AT__STATES && reference < AT__RATES;
  const int is_input = reference >= AT__INPUTS && reference < AT__PARAMETERS;
  const int is_parameter = reference >= AT__PARAMETERS && reference < AT__OUTPUTS;
  const char *problem = NULL;
  if (reference >= COUNT__ALL) {
    problem = "there is no variable of this value reference";
  } else if (!is_state && !is_input && !is_parameter) {
    problem = "time, derivatives and outputs are computed: only states, inputs and parameters can "
        "be set";
  } else if (m->within && !(is_input && moves_within[reference - AT__INPUTS])) {
    problem = "within a step only inputs can be set that are not held between samples";
  } else if (!isfinite(value)) {
    problem = "a value to set is not finite";
  } else if (reference == AT__STEP && value <= 0.0) {
    problem = "rk4_step must be above 0 s";
  }
  if (problem) {
    m->refused = 1;
  } else {
    m->now.value[reference] = value;
    m->now.stale = 1;
  }
  return problem;
}

/* Whether the training data were left, which is asked where somebody reads logs, and told once. */
static int strays(Instance *m) {
  double distance;
  if (!m->logging || m->strayed || get_value(m, AT__DISTANCE, &distance)) return 0;
  m->strayed = distance > 1.0 + 1e-6;
  return m->strayed;
}

static const char *values_got(Instance *m, const unsigned int r[], size_t n, double v[]) {
  size_t i;
  for (i = 0; i < n; ++i) {
    if (get_value(m, r[i], &v[i])) return "there is no variable of this value reference";
  }
  return NULL;
}

static const char *values_set(Instance *m, const unsigned int r[], size_t n, const double v[]) {
  size_t i;
  for (i = 0; i < n; ++i) {
    const char *problem = set_value(m, r[i], v[i]);
    if (problem) return problem;
  }
  return NULL;
}

static const char *states_copied(double *to, const double *from, size_t n) {
  if (n != COUNT__STATES) return "another number of states was expected";
  memcpy(to, from, n * sizeof *to);
  return NULL;
}

/* Keep a state in memory of its own, which is made if there is none. */
static int state_kept(void **kept, const void *state) {
  if (!*kept) *kept = malloc(sizeof(State));
  if (*kept) memcpy(*kept, state, sizeof(State));
  return *kept != NULL;
}

/* Inputs at a time within a step, so many seconds after its start. */
static int inputs_at(Instance *m, double start, double since, double *inputs) {
  double (*d)[COUNT__INPUTS + 1] = m->now.slope;
  const double *v = m->now.value + AT__INPUTS;
  int i;
  if (m->ask && !m->ask(m, start + since)) return 1;
  for (i = 0; i < COUNT__INPUTS; ++i) {
    inputs[i] = v[i] + since * (d[0][i] + since / 2.0 * (d[1][i] + since / 3.0 * d[2][i]));
  }
  return 0;
}

/* March to another time by classical Runge-Kutta steps of at most `step`; a problem, or NULL. */
static const char *marched(Instance *m, double start, double seconds) {
  double *v = m->now.value, *x = v + AT__STATES;
  double k[4][COUNT__STATES], at[COUNT__STATES], inputs[COUNT__INPUTS + 1];
  const double count = ceil(seconds / v[AT__STEP] - 1e-6);
  double h;
  long n, steps;
  int i, s;
  if (!(seconds >= 0.0)) return "the step could not be made: it goes back in time";
  if (!(count < 1e9)) return "the step could not be made: rk4_step divides it into too many";
  steps = seconds > 0.0 ? (count < 1.0 ? 1 : (long)count) : 0;
  h = seconds / (double)(steps ? steps : 1);
  for (n = 0; n < steps; ++n) {
#if TURNS
    const double before = x[SPEED];
#endif
    for (s = 0; s < 4; ++s) {
      const double share = 0.5 * ((s + 1) / 2);
      for (i = 0; i < COUNT__STATES; ++i) at[i] = s ? x[i] + share * h * k[s - 1][i] : x[i];
      /* The third of four is at the time of the second, the first at that of the last before. */
      if (s != 2 && (s || !n) && inputs_at(m, start, h * ((double)n + share), inputs)) {
        return "the step could not be made: an input within it could not be set";
      }
      if (rates(v + AT__PARAMETERS, at, inputs, k[s])) return "no derivatives of these states";
    }
    for (i = 0; i < COUNT__STATES; ++i) {
      x[i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
    }
#if TURNS
    /* The azimuth is the integral of the speed by the trapezoidal rule, as in dfsm. */
    x[COUNT__STATES - 1] += 0.5 * h * RADIANS * (before + x[SPEED])
        - h / 6.0 * (k[0][i - 1] + 2.0 * k[1][i - 1] + 2.0 * k[2][i - 1] + k[3][i - 1]);
#endif
  }
  if (steps) memcpy(v + AT__INPUTS, inputs, sizeof(double) * COUNT__INPUTS);
  m->now.stale = 1;
  for (i = 0; i < COUNT__STATES; ++i) {
    if (!isfinite(x[i])) return "the step could not be made: a state is not finite";
  }
  v[0] = start + seconds;
  return NULL;
}

static const char *march(Instance *m, double start, double seconds) {
  const char *problem;
  m->within = 1;
  problem = marched(m, start, seconds);
  m->within = 0;
  memset(m->now.slope, 0, sizeof m->now.slope);
  return problem;
}
