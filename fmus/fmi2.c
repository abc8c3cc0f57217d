/* FMI 2.0 Co-Simulation: every element of a variable is one scalar, whose value reference is its place in `values`. */
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "model.h"

typedef struct {
    const fmi2CallbackFunctions *callbacks;
    char name[];
} Importer;

static void log_error(const Plant *plant, const char *message) {
    const Importer *importer = plant->importer;
    /* Some importers do not expand formats, so no message has a percent sign. */
    if (importer->callbacks && importer->callbacks->logger)
        importer->callbacks->logger(
            importer->callbacks->componentEnvironment, importer->name, fmi2Error, "logStatusError", message);
}

/* ---- life ---- */

FMI2_Export const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
FMI2_Export const char *fmi2GetVersion(void) { return "2.0"; }

FMI2_Export fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    (void)c, (void)on, (void)n, (void)categories; /* errors are always logged, and nothing else is */
    return fmi2OK;
}

FMI2_Export fmi2Component fmi2Instantiate(
    fmi2String name, fmi2Type type, fmi2String token, fmi2String resources, const fmi2CallbackFunctions *callbacks,
    fmi2Boolean visible, fmi2Boolean logging) {
    (void)resources, (void)visible, (void)logging;
    if (!name) name = "";
    Importer *importer = malloc(sizeof *importer + strlen(name) + 1);
    if (!importer) return 0;
    importer->callbacks = callbacks;
    strcpy(importer->name, name);
    Plant *plant = model_new(type == fmi2CoSimulation ? STEPPING : 0, token, log_error, importer);
    if (!plant) free(importer);
    return plant;
}

FMI2_Export void fmi2FreeInstance(fmi2Component c) {
    Plant *plant = c;
    if (!plant) return;
    free((void *)plant->importer);
    model_free(plant);
}

FMI2_Export fmi2Status fmi2Reset(fmi2Component c) {
    model_reset(c);
    return fmi2OK;
}

FMI2_Export fmi2Status fmi2SetupExperiment(
    fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real start_time, fmi2Boolean stop_defined,
    fmi2Real stop_time) {
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop_time;
    if (model_require(c, INSTANTIATED, __func__) != OK) return fmi2Error;
    ((Plant *)c)->state.time = start_time;
    return fmi2OK;
}

FMI2_Export fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    return (fmi2Status)model_enter_initialization(c, ((Plant *)c)->state.time);
}

FMI2_Export fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return (fmi2Status)model_exit_initialization(c); }

FMI2_Export fmi2Status fmi2Terminate(fmi2Component c) { return (fmi2Status)model_terminate(c); }

FMI2_Export fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_set_state) {
    (void)no_set_state;
    return (fmi2Status)model_step(c, time, step);
}

/* ---- variables ---- */

static unsigned variable_at(fmi2ValueReference reference) { return reference < VALUES ? variable_of[reference] : VARIABLES; }

static Status get(Plant *plant, fmi2ValueReference reference, int integer, double *value) {
    unsigned v = variable_at(reference);
    return model_get(plant, v, v < VARIABLES ? (int)reference - offset[v] : 0, 1, integer, value);
}

static Status set(Plant *plant, fmi2ValueReference reference, int integer, double value) {
    unsigned v = variable_at(reference);
    return model_set(plant, v, v < VARIABLES ? (int)reference - offset[v] : 0, 1, integer, &value);
}

FMI2_Export fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference references[], size_t n, fmi2Real values[]) {
    for (size_t i = 0; i < n; i++)
        if (get(c, references[i], 0, values + i) != OK) return fmi2Error;
    return fmi2OK;
}

FMI2_Export fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference references[], size_t n, const fmi2Real values[]) {
    Status status = OK;
    for (size_t i = 0; i < n && status == OK; i++) status = set(c, references[i], 0, values[i]);
    return (fmi2Status)model_end_set(c, status);
}

FMI2_Export fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference references[], size_t n, fmi2Integer values[]) {
    for (size_t i = 0; i < n; i++) {
        double value;
        if (get(c, references[i], 1, &value) != OK) return fmi2Error;
        values[i] = (fmi2Integer)value;
    }
    return fmi2OK;
}

FMI2_Export fmi2Status fmi2SetInteger(
    fmi2Component c, const fmi2ValueReference references[], size_t n, const fmi2Integer values[]) {
    for (size_t i = 0; i < n; i++)
        if (set(c, references[i], 1, values[i]) != OK) return fmi2Error;
    return fmi2OK;
}

/* ---- derivatives ---- */

FMI2_Export fmi2Status fmi2GetDirectionalDerivative(
    fmi2Component c, const fmi2ValueReference unknowns[], size_t n_unknowns, const fmi2ValueReference knowns[], size_t n_knowns,
    const fmi2Real seed[], fmi2Real sensitivity[]) {
    double known[VALUES] = {0}, unknown[VALUES] = {0};
    for (size_t i = 0; i < n_unknowns; i++)
        if (model_may_derive(c, variable_at(unknowns[i]), 1) != OK) return fmi2Error;
    for (size_t i = 0; i < n_knowns; i++) {
        if (model_may_derive(c, variable_at(knowns[i]), 0) != OK) return fmi2Error;
        known[knowns[i]] += seed[i];
    }
    model_forward(c, known, unknown);
    for (size_t i = 0; i < n_unknowns; i++) sensitivity[i] = unknown[unknowns[i]];
    return fmi2OK;
}

/* ---- state ---- */

FMI2_Export fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *saved) { return (fmi2Status)model_save(c, saved); }

FMI2_Export fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate saved) {
    return (fmi2Status)model_restore(c, saved);
}

FMI2_Export fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *saved) {
    (void)c;
    if (!saved) return fmi2OK;
    free(*saved);
    *saved = 0;
    return fmi2OK;
}

FMI2_Export fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate saved, size_t *size) {
    (void)c, (void)saved;
    *size = sizeof(Serialized);
    return fmi2OK;
}

FMI2_Export fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate saved, fmi2Byte bytes[], size_t size) {
    return (fmi2Status)model_serialize(c, saved, bytes, size);
}

FMI2_Export fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *saved) {
    return (fmi2Status)model_deserialize(c, bytes, size, saved);
}
