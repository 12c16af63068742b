/* Functions of FMI 3.0 around an instance of the model. */
#include <stdbool.h>
#include <stdint.h>

typedef void *fmi3Instance;
typedef uint32_t fmi3ValueReference;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef void (*fmi3Logger)(void *, fmi3Status, const char *, const char *);

/* What fmi.c takes. */
#define FMI(name) fmi3##name
#define STATE(before, after) fmi3##before##FMUState##after
#define DESERIALIZE fmi3DeserializeFMUState
#define DERIVATIVES fmi3GetContinuousStateDerivatives
typedef bool fmi3Boolean;
typedef uint8_t Byte;

static fmi3Status told(Instance *m, fmi3Status status, const char *text) {
  if (status != fmi3OK && m->logger) {
    const char *kind = status == fmi3Warning ? "logStatusWarning" : "logStatusError";
    ((fmi3Logger)m->logger)(m->environment, status, kind, text);
  }
  return status;
}
static fmi3Instance made(const char *name, const char *token, bool logging, void *environment,
    fmi3Logger logger) {
  Instance *m;
  if (!token || strcmp(token, MODEL_TOKEN)) return NULL;
  m = instance_new(name);
  if (m) {
    m->logging = logging;
    m->environment = environment;
    m->logger = (Function)logger;
  }
  return m;
}

API const char *fmi3GetVersion(void) { return "3.0"; }
API fmi3Instance fmi3InstantiateModelExchange(const char *name, const char *token,
    const char *resources, bool visible, bool logging, void *environment, fmi3Logger logger) {
  (void)resources; (void)visible;
  return made(name, token, logging, environment, logger);
}
typedef void (*fmi3Update)(void *, double, bool, bool, bool, bool, bool *, double *);

/* Inputs at a time within a step, which the importer sets while it is asked. */
static int asked(Instance *m, double time) {
  bool early = false;
  double stop = time;
  m->refused = 0;
  ((fmi3Update)m->update)(m->environment, time, true, false, false, false, &early, &stop);
  return !m->refused;
}
API fmi3Instance fmi3InstantiateCoSimulation(const char *name, const char *token,
    const char *resources, bool visible, bool logging, bool eventMode, bool earlyReturn,
    const fmi3ValueReference required[], size_t n, void *environment, fmi3Logger logger,
    fmi3Update update) {
  Instance *m = (Instance *)made(name, token, logging, environment, logger);
  (void)resources; (void)visible; (void)eventMode; (void)earlyReturn; (void)required;
  if (m && update && n) {
    m->ask = asked;
    m->update = (Function)update;
  }
  return m;
}
API fmi3Instance fmi3InstantiateScheduledExecution(const char *name, const char *token,
    const char *resources, bool visible, bool logging, void *environment, fmi3Logger logger,
    void *clock, void *lock, void *unlock) {
  (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment;
  (void)logger; (void)clock; (void)lock; (void)unlock;
  return NULL;
}
API fmi3Status fmi3EnterInitializationMode(fmi3Instance c, bool toleranceDefined, double tolerance,
    double start, bool stopDefined, double stop) {
  SELF; (void)toleranceDefined; (void)tolerance; (void)stopDefined; (void)stop;
  m->now.value[0] = start; return fmi3OK;
}
API fmi3Status fmi3EnterStepMode(fmi3Instance c) { SELF; return fmi3OK; }
API fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { SELF; return fmi3OK; }
API fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { SELF; return fmi3OK; }

API fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n, double v[],
    size_t nv) {
  SELF; ANSWER(nv == n ? values_got(m, r, n, v) : "one value per variable was expected");
}
API fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n,
    const double v[], size_t nv) {
  SELF; ANSWER(nv == n ? values_set(m, r, n, v) : "one value per variable was expected");
}
#define NONE(kind, type) \
  API fmi3Status fmi3Get##kind(fmi3Instance c, const fmi3ValueReference r[], size_t n, type v[], \
      size_t nv) { \
    SELF; (void)r; (void)v; (void)nv; \
    return n ? told(m, fmi3Error, "all variables are Float64") : fmi3OK; \
  } \
  API fmi3Status fmi3Set##kind(fmi3Instance c, const fmi3ValueReference r[], size_t n, \
      const type v[], size_t nv) { \
    SELF; (void)r; (void)v; (void)nv; \
    return n ? told(m, fmi3Error, "all variables are Float64") : fmi3OK; \
  }
NONE(Float32, float)
NONE(Int8, int8_t)
NONE(UInt8, uint8_t)
NONE(Int16, int16_t)
NONE(UInt16, uint16_t)
NONE(Int32, int32_t)
NONE(UInt32, uint32_t)
NONE(Int64, int64_t)
NONE(UInt64, uint64_t)
NONE(Boolean, bool)
typedef const char *fmi3Text;
NONE(String, fmi3Text)
API fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference r[], size_t n, size_t s[],
    const uint8_t *v[], size_t nv) {
  SELF; (void)r; (void)s; (void)v; (void)nv; return n ? fmi3Error : fmi3OK;
}
API fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference r[], size_t n,
    const size_t s[], const uint8_t *const v[], size_t nv) {
  SELF; (void)r; (void)s; (void)v; (void)nv; return n ? fmi3Error : fmi3OK;
}
API fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference r[], size_t n, bool v[]) {
  SELF; (void)r; (void)v; return n ? fmi3Error : fmi3OK;
}
API fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference r[], size_t n,
    const bool v[]) {
  SELF; (void)r; (void)v; return n ? fmi3Error : fmi3OK;
}
API fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference r,
    size_t *n) {
  SELF; (void)r; (void)n; return told(m, fmi3Error, "see the model description");
}
API fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference r, size_t i[],
    fmi3ValueReference d[], size_t j[], int k[], size_t n) {
  SELF; (void)r; (void)i; (void)d; (void)j; (void)k; (void)n;
  return told(m, fmi3Error, "see the model description");
}
API fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference u[], size_t nu,
    const fmi3ValueReference k[], size_t nk, const double s[], size_t ns, double d[], size_t nd) {
  SELF; (void)u; (void)nu; (void)k; (void)nk; (void)s; (void)ns; (void)d; (void)nd;
  return told(m, fmi3Error, "directional derivatives are not provided");
}
API fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference u[], size_t nu,
    const fmi3ValueReference k[], size_t nk, const double s[], size_t ns, double d[], size_t nd) {
  SELF; (void)u; (void)nu; (void)k; (void)nk; (void)s; (void)ns; (void)d; (void)nd;
  return told(m, fmi3Error, "adjoint derivatives are not provided");
}
#define CLOCKS(name, a, b) \
  API fmi3Status name(fmi3Instance c, const fmi3ValueReference r[], size_t n, a, b) { \
    SELF; (void)r; (void)x; (void)y; return n ? fmi3Error : fmi3OK; \
  }
CLOCKS(fmi3GetIntervalFraction, uint64_t x[], uint64_t y[])
CLOCKS(fmi3GetShiftFraction, uint64_t x[], uint64_t y[])
CLOCKS(fmi3SetIntervalFraction, const uint64_t x[], const uint64_t y[])
CLOCKS(fmi3SetShiftFraction, const uint64_t x[], const uint64_t y[])
CLOCKS(fmi3GetIntervalDecimal, double x[], int y[])
#define CLOCK(name, a) \
  API fmi3Status name(fmi3Instance c, const fmi3ValueReference r[], size_t n, a) { \
    SELF; (void)r; (void)x; return n ? fmi3Error : fmi3OK; \
  }
CLOCK(fmi3GetShiftDecimal, double x[])
CLOCK(fmi3SetIntervalDecimal, const double x[])
CLOCK(fmi3SetShiftDecimal, const double x[])
API fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) { SELF; return fmi3OK; }
API fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, bool *needed, bool *terminate,
    bool *nominals, bool *values, bool *defined, double *next) {
  SELF;
  *needed = *terminate = *nominals = *values = *defined = false;
  *next = 0.0;
  return fmi3OK;
}

/* -- model exchange -- */
API fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) {
  SELF; *n = 0; return fmi3OK;
}
API fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) {
  SELF; *n = COUNT__STATES; return fmi3OK;
}

/* -- co-simulation -- */
API fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference r[], size_t n,
    const int32_t order[], double v[], size_t nv) {
  SELF; (void)r; (void)order; (void)v; (void)nv;
  return n ? told(m, fmi3Error, "derivatives of outputs are not provided") : fmi3OK;
}
API fmi3Status fmi3DoStep(fmi3Instance c, double t, double h, bool noSetPrior, bool *event,
    bool *terminate, bool *early, double *last) {
  const char *text;
  SELF;
  (void)noSetPrior;
  *event = *terminate = *early = false;
  text = march(m, t, h);
  *last = m->now.value[0];
  if (!text && strays(m)) told(m, fmi3Warning, STRAYED);
  return text ? told(m, fmi3Error, text) : fmi3OK;
}
API fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference r, double t) {
  SELF; (void)r; (void)t; return fmi3Error;
}
