/* A damped pendulum as an FMU for model exchange (FMI 2.0): m l² φ'' = u + w − c φ' − m g l sin φ. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#define OK 0
#define ERROR 3
typedef void *component;
typedef struct { int needed, terminate, nominals, values, defined; double next; } event_info;
enum { PHI, OMEGA, ACCELERATION, U, W, M, C, SIZE };  /* value references; PHI' is OMEGA */
#define EXPORT __attribute__((visibility("default")))

static void start(double *v) { memset(v, 0, SIZE * sizeof *v); v[M] = 1.0; v[C] = 0.1; }
EXPORT component fmi2Instantiate(const char *n, int t, const char *g, const char *r, const void *f, int a, int b)
{ double *v = malloc(SIZE * sizeof *v); (void)n; (void)t; (void)g; (void)r; (void)f; (void)a; (void)b; start(v); return v; }
EXPORT void fmi2FreeInstance(component c) { free(c); }
EXPORT int fmi2Reset(component c) { start(c); return OK; }
EXPORT int fmi2SetupExperiment(component c, int a, double b, double d, int e, double f)
{ (void)c; (void)a; (void)b; (void)d; (void)e; (void)f; return OK; }
EXPORT int fmi2EnterInitializationMode(component c) { (void)c; return OK; }
EXPORT int fmi2ExitInitializationMode(component c) { (void)c; return OK; }
EXPORT int fmi2NewDiscreteStates(component c, event_info *e) { (void)c; memset(e, 0, sizeof *e); return OK; }
EXPORT int fmi2EnterContinuousTimeMode(component c) { (void)c; return OK; }
EXPORT int fmi2EnterEventMode(component c) { (void)c; return OK; }
EXPORT int fmi2Terminate(component c) { (void)c; return OK; }
EXPORT int fmi2SetReal(component c, const unsigned r[], size_t n, const double x[])
{ for (size_t i = 0; i < n; i++) ((double *)c)[r[i]] = x[i]; return OK; }
EXPORT int fmi2GetReal(component c, const unsigned r[], size_t n, double x[])
{ for (size_t i = 0; i < n; i++) x[i] = ((double *)c)[r[i]]; return OK; }
EXPORT int fmi2SetContinuousStates(component c, const double x[], size_t n)
{ if (n != 2) return ERROR; memcpy(c, x, 2 * sizeof *x); return OK; }
EXPORT int fmi2GetContinuousStates(component c, double x[], size_t n) { memcpy(x, c, n * sizeof *x); return OK; }
EXPORT int fmi2GetDerivatives(component c, double dx[], size_t n)
{
    const double *v = c;
    if (n != 2 || v[OMEGA] > 1e3) return ERROR;
    dx[0] = v[OMEGA];
    dx[1] = (v[U] + v[W] - v[C] * v[OMEGA] - v[M] * 9.81 * sin(v[PHI])) / v[M];
    return OK;
}
#define NOTHING(name) EXPORT int name(void) { return ERROR; }
NOTHING(fmi2GetInteger) NOTHING(fmi2SetInteger) NOTHING(fmi2GetBoolean) NOTHING(fmi2SetBoolean) NOTHING(fmi2GetString)
NOTHING(fmi2SetString) NOTHING(fmi2GetFMUstate) NOTHING(fmi2SetFMUstate) NOTHING(fmi2FreeFMUstate)
NOTHING(fmi2SerializedFMUstateSize) NOTHING(fmi2SerializeFMUstate) NOTHING(fmi2DeSerializeFMUstate)
NOTHING(fmi2GetDirectionalDerivative) NOTHING(fmi2SetDebugLogging) NOTHING(fmi2CompletedIntegratorStep)
NOTHING(fmi2SetTime) NOTHING(fmi2GetEventIndicators) NOTHING(fmi2GetNominalsOfContinuousStates)
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
