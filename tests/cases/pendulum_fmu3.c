/* The pendulum of pendulum_fmu.c in the words of FMI 3.0. */
#include <stdbool.h>
#include "pendulum_fmu.c"
EXPORT component fmi3InstantiateModelExchange
(const char *n, const char *g, const char *r, bool a, bool b, void *e, void *f)
{ (void)e; (void)f; return fmi2Instantiate(n, 0, g, r, 0, a, b); }
EXPORT void fmi3FreeInstance(component c) { fmi2FreeInstance(c); }
EXPORT int fmi3Reset(component c) { return fmi2Reset(c); }
EXPORT int fmi3EnterInitializationMode(component c, bool a, double b, double d, bool e, double f)
{ (void)c; (void)a; (void)b; (void)d; (void)e; (void)f; return OK; }
EXPORT int fmi3ExitInitializationMode(component c) { (void)c; return OK; }
EXPORT int fmi3UpdateDiscreteStates(component c, bool *a, bool *b, bool *d, bool *e, bool *f, double *t)
{ (void)c; *a = *b = *d = *e = *f = false; *t = 0; return OK; }
EXPORT int fmi3EnterContinuousTimeMode(component c) { (void)c; return OK; }
EXPORT int fmi3SetFloat64(component c, const unsigned r[], size_t n, const double x[], size_t m)
{ (void)m; return fmi2SetReal(c, r, n, x); }
EXPORT int fmi3SetContinuousStates(component c, const double x[], size_t n) { return fmi2SetContinuousStates(c, x, n); }
EXPORT int fmi3GetContinuousStateDerivatives(component c, double dx[], size_t n) { return fmi2GetDerivatives(c, dx, n); }
NOTHING(fmi3ActivateModelPartition) NOTHING(fmi3CompletedIntegratorStep) NOTHING(fmi3DeserializeFMUState)
NOTHING(fmi3DoStep) NOTHING(fmi3EnterConfigurationMode) NOTHING(fmi3EnterEventMode) NOTHING(fmi3EnterStepMode)
NOTHING(fmi3EvaluateDiscreteStates) NOTHING(fmi3ExitConfigurationMode) NOTHING(fmi3FreeFMUState)
NOTHING(fmi3GetAdjointDerivative) NOTHING(fmi3GetBinary) NOTHING(fmi3GetBoolean) NOTHING(fmi3GetClock)
NOTHING(fmi3GetContinuousStates) NOTHING(fmi3GetDirectionalDerivative) NOTHING(fmi3GetEventIndicators)
NOTHING(fmi3GetFMUState) NOTHING(fmi3GetFloat32) NOTHING(fmi3GetFloat64) NOTHING(fmi3GetInt16) NOTHING(fmi3GetInt32)
NOTHING(fmi3GetInt64) NOTHING(fmi3GetInt8) NOTHING(fmi3GetIntervalDecimal) NOTHING(fmi3GetIntervalFraction)
NOTHING(fmi3GetNominalsOfContinuousStates) NOTHING(fmi3GetNumberOfContinuousStates)
NOTHING(fmi3GetNumberOfEventIndicators) NOTHING(fmi3GetNumberOfVariableDependencies) NOTHING(fmi3GetOutputDerivatives)
NOTHING(fmi3GetShiftDecimal) NOTHING(fmi3GetShiftFraction) NOTHING(fmi3GetString) NOTHING(fmi3GetUInt16)
NOTHING(fmi3GetUInt32) NOTHING(fmi3GetUInt64) NOTHING(fmi3GetUInt8) NOTHING(fmi3GetVariableDependencies)
NOTHING(fmi3GetVersion) NOTHING(fmi3InstantiateCoSimulation) NOTHING(fmi3InstantiateScheduledExecution)
NOTHING(fmi3SerializeFMUState) NOTHING(fmi3SerializedFMUStateSize) NOTHING(fmi3SetBinary) NOTHING(fmi3SetBoolean)
NOTHING(fmi3SetClock) NOTHING(fmi3SetDebugLogging) NOTHING(fmi3SetFMUState) NOTHING(fmi3SetFloat32)
NOTHING(fmi3SetInt16) NOTHING(fmi3SetInt32) NOTHING(fmi3SetInt64) NOTHING(fmi3SetInt8) NOTHING(fmi3SetIntervalDecimal)
NOTHING(fmi3SetIntervalFraction) NOTHING(fmi3SetShiftDecimal) NOTHING(fmi3SetShiftFraction) NOTHING(fmi3SetString)
NOTHING(fmi3SetTime) NOTHING(fmi3SetUInt16) NOTHING(fmi3SetUInt32) NOTHING(fmi3SetUInt64) NOTHING(fmi3SetUInt8)
NOTHING(fmi3Terminate)
