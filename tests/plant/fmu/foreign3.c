/* The hexapod of foreign.c behind FMI 3.0: arrays instead of scalars, and other names and units. Beside the statuses it can be told
 * to raise the flags of fmi3DoStep. stubs.c has the functions that this FMU lacks.
 */
#include <stdarg.h>

#include "fmi3Functions.h"
#include "foreign.c"

enum { ENDS = 10, MEETS_EVENT = 11, RETURNS_EARLY = 12 };

/* Values of FMI 3.0 are those of `reals` times a factor, from one or two places; variables are numbered from 1. */
static const struct {
    int from, count, then_from, then_count;
    double factor;
} ARRAYS[] = {
    {RETRACT, 6, 0, 0, 0.06},               /* drive.shrink, m/min */
    {LAG, 1, 0, 0, 1},                      /* drive.lag, s */
    {FAULT_AT, 1, 0, 0, 1},                 /* trouble.time, s */
    {LEG_GYRO, 18, TOP_GYRO, 3, 1.0 / 6.0}, /* imu.turn, rpm */
    {LEG_ACC, 18, TOP_ACC, 3, 1000},        /* imu.pull, mg */
    {POSE, 3, 0, 0, 0.1},                   /* platform.place, cm */
    {ATTITUDE, 4, 0, 0, 1},                 /* platform.attitude */
    {EXTENSION, 6, 0, 0, 0.1},              /* drive.extension, cm */
};

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Listener;

static void forward(fmi2ComponentEnvironment to, fmi2String name, fmi2Status status, fmi2String category, fmi2String format, ...) {
    char text[200];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    (void)name;
    ((Listener *)to)->log(((Listener *)to)->environment, (fmi3Status)status, category, text);
}

const char *fmi3GetVersion(void) { return "3.0"; }

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference vr[],
                                         size_t n, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
    (void)events, (void)early, (void)vr, (void)n, (void)update;
    Listener *listener = malloc(sizeof *listener);
    listener->environment = environment;
    listener->log = log;
    fmi2CallbackFunctions functions = {forward, calloc, free, 0, listener};
    return fmi2Instantiate(name, fmi2CoSimulation, token, resources, &functions, visible, logging);
}
void fmi3FreeInstance(fmi3Instance c) {
    free(((Hexapod *)c)->call.componentEnvironment);
    fmi2FreeInstance(c);
}
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean a, fmi3Float64 b, fmi3Float64 start, fmi3Boolean d, fmi3Float64 e) {
    return (fmi3Status)fmi2SetupExperiment(c, a, b, start, d, e);
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return (fmi3Status)fmi2ExitInitializationMode(c); }
fmi3Status fmi3Terminate(fmi3Instance c) { return (fmi3Status)fmi2Terminate(c); }

static fmi3Status exchange(Hexapod *h, const fmi3ValueReference vr[], size_t n, double values[], size_t count, int set) {
    size_t at = 0;
    for (size_t i = 0; i < n; i++)
        for (int k = 0; k < ARRAYS[vr[i] - 1].count + ARRAYS[vr[i] - 1].then_count; k++, at++) {
            int first = ARRAYS[vr[i] - 1].count;
            double *real = h->state.reals + (k < first ? ARRAYS[vr[i] - 1].from + k : ARRAYS[vr[i] - 1].then_from + k - first);
            if (at >= count) return fmi3Error;
            if (set) *real = values[at] / ARRAYS[vr[i] - 1].factor;
            else values[at] = *real * ARRAYS[vr[i] - 1].factor;
        }
    return at == count ? fmi3OK : fmi3Error;
}
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[], size_t count) {
    return exchange(c, vr, n, values, count, 0);
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 values[], size_t count) {
    return exchange(c, vr, n, (double *)values, count, 1);
}
fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Boolean values[], size_t count) {
    (void)vr;
    if (n != 1 || count != 1) return fmi3Error;
    /* The brake, not the servo. */
    ((Hexapod *)c)->state.servo_on = !values[0];
    return fmi3OK;
}
fmi3Status fmi3SetUInt8(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3UInt8 values[], size_t count) {
    (void)vr;
    if (n != 1 || count != 1) return fmi3Error;
    ((Hexapod *)c)->state.fault_status = values[0];
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_set, fmi3Boolean *event, fmi3Boolean *end,
                      fmi3Boolean *early, fmi3Float64 *reached) {
    int trouble = time >= ((Hexapod *)c)->state.reals[FAULT_AT] ? ((Hexapod *)c)->state.fault_status : 0;
    *event = trouble == MEETS_EVENT;
    *end = trouble == ENDS;
    *early = trouble == RETURNS_EARLY;
    *reached = trouble == RETURNS_EARLY ? time + step / 2 : time + step;
    return trouble >= ENDS ? fmi3OK : (fmi3Status)fmi2DoStep(c, time, step, no_set);
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) { return (fmi3Status)fmi2GetFMUstate(c, state); }
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) { return (fmi3Status)fmi2SetFMUstate(c, state); }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) { return (fmi3Status)fmi2FreeFMUstate(c, state); }
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    return (fmi3Status)fmi2SerializedFMUstateSize(c, state, size);
}
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    return (fmi3Status)fmi2SerializeFMUstate(c, state, (fmi2Byte *)bytes, size);
}
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    return (fmi3Status)fmi2DeSerializeFMUstate(c, (const fmi2Byte *)bytes, size, state);
}
