/* A hexapod as somebody else would write it, for FMI 2.0: no dynamics, but drives of the first order, and the pose that belongs to
 * the leg lengths by Newton's iteration. Scalars only; millimetres, degrees and g; legs are told how fast to become shorter, and
 * accelerometers read the other way round. What the IMUs read are differences of poses just before and just after.
 *
 * geometry.h has BASE[6][3], PLATFORM[6][3], AXES[6][3], LEG_IMU[6][3], PLATFORM_IMU[3], HOME[3] and GRAVITY[3] in millimetres.
 */
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fmi2Functions.h"
#include "geometry.h"

enum { RETRACT = 0, LAG = 6, FAULT_AT = 7, LEG_GYRO = 8, LEG_ACC = 26, TOP_GYRO = 44, TOP_ACC = 47, POSE = 50, ATTITUDE = 53,
       EXTENSION = 57, REALS = 63, SLOW = 94, INFINITE = 95, NOT_A_NUMBER = 96, EXIT = 97, HANG = 98, CRASH = 99 };
#define FIRST_REAL 1000
#define TUBE 300.0
#define G 9806.65
#define DEGREE (3.14159265358979323846 / 180)
#define NEAR 1e-4

typedef struct {
    double p[3], R[3][3];
} Pose;

typedef struct {
    double time, reals[REALS], length[6], speed[6];
    int servo_on, fault_status, started;
    Pose pose;
} State;

typedef struct {
    State state;
    fmi2CallbackFunctions call;
    char name[64];
} Hexapod;

static void cross(const double *a, const double *b, double *c) {
    for (int i = 0; i < 3; i++) c[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void turn(const double R[3][3], const double *v, double *w) {
    for (int i = 0; i < 3; i++) w[i] = dot(R[i], v);
}

static void rotate(Pose *pose, const double *angle) {
    double theta = sqrt(dot(angle, angle)), s = theta > 1e-12 ? sin(theta) / theta : 1, c = theta > 1e-6 ? (1 - cos(theta)) / (theta * theta) : 0.5;
    for (int column = 0; column < 3; column++) {
        double v[3] = {pose->R[0][column], pose->R[1][column], pose->R[2][column]}, once[3], twice[3];
        cross(angle, v, once);
        cross(angle, once, twice);
        for (int i = 0; i < 3; i++) pose->R[i][column] += s * once[i] + c * twice[i];
    }
}

static void solve(double m[6][7]) {
    for (int k = 0; k < 6; k++) {
        int best = k;
        for (int i = k + 1; i < 6; i++)
            if (fabs(m[i][k]) > fabs(m[best][k])) best = i;
        for (int j = 0; j < 7; j++) {
            double held = m[k][j];
            m[k][j] = m[best][j];
            m[best][j] = held;
        }
        for (int i = 0; i < 6; i++) {
            if (i == k) continue;
            double share = m[i][k] / m[k][k];
            for (int j = k; j < 7; j++) m[i][j] -= share * m[k][j];
        }
    }
    for (int k = 0; k < 6; k++) m[k][6] /= m[k][k];
}

static void legs(const Pose *pose, double leg[6][3], double arm[6][3]) {
    for (int k = 0; k < 6; k++) {
        turn(pose->R, PLATFORM[k], arm[k]);
        for (int i = 0; i < 3; i++) leg[k][i] = pose->p[i] + arm[k][i] - BASE[k][i];
    }
}

static int find_pose(const double *length, Pose *pose) {
    for (int round = 0; round < 20; round++) {
        double leg[6][3], arm[6][3], m[6][7], worst = 0;
        legs(pose, leg, arm);
        for (int k = 0; k < 6; k++) {
            double size = sqrt(dot(leg[k], leg[k]));
            for (int i = 0; i < 3; i++) m[k][i] = leg[k][i] / size;
            cross(arm[k], m[k], m[k] + 3);
            m[k][6] = length[k] - size;
            worst = fmax(worst, fabs(m[k][6]));
        }
        if (worst < 1e-12) return 1;
        solve(m);
        double angle[3] = {m[3][6], m[4][6], m[5][6]};
        for (int i = 0; i < 3; i++) pose->p[i] += m[i][6];
        rotate(pose, angle);
        if (worst < 1e-7) return 1;
    }
    return 0;
}

static void drive(State *s, double time, double *length, double *speed) {
    double left = exp(-time / s->reals[LAG]);
    for (int k = 0; k < 6; k++) {
        double told = s->servo_on ? -s->reals[RETRACT + k] : 0, over = s->speed[k] - told;
        length[k] = s->length[k] + told * time + over * s->reals[LAG] * (1 - left);
        speed[k] = told + over * left;
    }
}

/* Place and attitude of IMU k; the platform's is the last. */
static void imu_at(const Pose *pose, int k, double *at, double R[3][3]) {
    if (k == 6) {
        memcpy(R, pose->R, sizeof pose->R);
        turn(pose->R, PLATFORM_IMU, at);
        for (int i = 0; i < 3; i++) at[i] += pose->p[i];
        return;
    }
    double leg[6][3], arm[6][3], x[3], y[3];
    legs(pose, leg, arm);
    double size = sqrt(dot(leg[k], leg[k]));
    for (int i = 0; i < 3; i++) leg[k][i] /= size;
    cross(leg[k], AXES[k], y);
    size = sqrt(dot(y, y));
    for (int i = 0; i < 3; i++) y[i] /= size;
    cross(y, leg[k], x);
    for (int i = 0; i < 3; i++) R[i][0] = x[i], R[i][1] = y[i], R[i][2] = leg[k][i];
    turn(R, LEG_IMU[k], at);
    for (int i = 0; i < 3; i++) at[i] += BASE[k][i];
}

static int measure(State *s) {
    Pose poses[3];
    double *reals = s->reals;
    for (int n = 0; n < 3; n++) {
        double length[6], speed[6];
        poses[n] = s->pose;
        drive(s, (n - 1) * NEAR, length, speed);
        if (!find_pose(length, &poses[n])) return 0;
    }
    s->pose = poses[1];
    for (int k = 0; k < 7; k++) {
        double at[3][3], R[3][3][3], force[3], *gyro = reals + LEG_GYRO + 3 * k, *acc = reals + LEG_ACC + 3 * k;
        if (k == 6) gyro = reals + TOP_GYRO, acc = reals + TOP_ACC;
        for (int n = 0; n < 3; n++) imu_at(&poses[n], k, at[n], R[n]);
        for (int i = 0; i < 3; i++) force[i] = (at[2][i] - 2 * at[1][i] + at[0][i]) / (NEAR * NEAR) - GRAVITY[i];
        for (int i = 0; i < 3; i++) {
            int j = (i + 1) % 3, m = (i + 2) % 3;
            double rate = 0, along = 0;
            for (int row = 0; row < 3; row++) {
                rate += (R[1][row][m] * (R[2][row][j] - R[0][row][j]) - R[1][row][j] * (R[2][row][m] - R[0][row][m])) / (4 * NEAR);
                along += R[1][row][i] * force[row];
            }
            gyro[i] = rate / DEGREE;
            acc[i] = -along / G;
        }
        if (k < 6) gyro[1] = -gyro[1];
    }
    for (int i = 0; i < 3; i++) reals[POSE + i] = s->pose.p[i];
    double *q = reals + ATTITUDE, (*R)[3] = s->pose.R;
    q[0] = 0.5 * sqrt(1 + R[0][0] + R[1][1] + R[2][2]);
    q[1] = (R[2][1] - R[1][2]) / (4 * q[0]);
    q[2] = (R[0][2] - R[2][0]) / (4 * q[0]);
    q[3] = (R[1][0] - R[0][1]) / (4 * q[0]);
    for (int k = 0; k < 6; k++) reals[EXTENSION + k] = s->length[k] - TUBE;
    return 1;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return "2.0"; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    return (void)c, (void)on, (void)n, (void)categories, fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    (void)type, (void)resources, (void)visible, (void)logging;
    Hexapod *h = functions->allocateMemory(1, sizeof *h);
    if (!h) return 0;
    h->call = *functions;
    strncpy(h->name, name, sizeof h->name - 1);
    State *s = &h->state;
    s->reals[LAG] = 0.02;
    /* A fault can be built in. */
    s->reals[FAULT_AT] = sscanf(guid, "{fault %d}", &s->fault_status) == 1 ? 0.003 : 1e9;
    for (int i = 0; i < 3; i++) s->pose.p[i] = HOME[i], s->pose.R[i][i] = 1;
    double leg[6][3], arm[6][3];
    legs(&s->pose, leg, arm);
    for (int k = 0; k < 6; k++) s->length[k] = sqrt(dot(leg[k], leg[k]));
    return h;
}

void fmi2FreeInstance(fmi2Component c) {
    Hexapod *h = c;
    if (h) h->call.freeMemory(h);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real start, fmi2Boolean d, fmi2Real e) {
    (void)a, (void)b, (void)d, (void)e;
    ((Hexapod *)c)->state.time = start;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    Hexapod *h = c;
    h->state.started = 1;
    if (h->state.reals[LAG] > 0) return measure(&h->state) ? fmi2OK : fmi2Error;
    h->call.logger(h->call.componentEnvironment, h->name, fmi2Error, "error", "the lag of the servos is %g s and must be positive", h->state.reals[LAG]);
    return fmi2Error;
}
fmi2Status fmi2Terminate(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { return (void)c, fmi2Error; }

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) value[i] = ((Hexapod *)c)->state.reals[vr[i] - FIRST_REAL];
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) ((Hexapod *)c)->state.reals[vr[i] - FIRST_REAL] = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value[]) {
    for (size_t i = 0; i < n; i++) value[i] = vr[i] == 1 ? ((Hexapod *)c)->state.fault_status : 0;
    return fmi2OK;
}
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer value[]) {
    for (size_t i = 0; i < n; i++)
        if (vr[i] == 1) ((Hexapod *)c)->state.fault_status = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[]) {
    for (size_t i = 0; i < n; i++) value[i] = ((Hexapod *)c)->state.servo_on;
    return (void)vr, fmi2OK;
}
fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[]) {
    for (size_t i = 0; i < n; i++) ((Hexapod *)c)->state.servo_on = value[i];
    return (void)vr, fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_set) {
    Hexapod *h = c;
    State *s = &h->state;
    double length[6], speed[6];
    /* This FMU can save its state, and wants to know that an earlier one may come back. */
    if (no_set) return fmi2Error;
    int fault = time >= s->reals[FAULT_AT] ? s->fault_status : 0;
    if (fault == CRASH) raise(SIGSEGV);
    if (fault == EXIT) exit(7);
    if (fault == SLOW) usleep(10000);
    if (fault == HANG) fputs("hanging\n", stderr);
    while (fault == HANG) pause();
    if (fault && fault < SLOW) {
        h->call.logger(h->call.componentEnvironment, h->name, s->fault_status, "servo", "servo %d is at %.1f degrees after %s", 3, 91.5, "a while");
        return (fmi2Status)s->fault_status;
    }
    drive(s, step, length, speed);
    memcpy(s->length, length, sizeof length);
    memcpy(s->speed, speed, sizeof speed);
    s->time = time + step;
    int good = measure(s);
    if (fault == INFINITE) s->reals[POSE + 1] = INFINITY;
    if (fault == NOT_A_NUMBER) s->reals[TOP_ACC + 2] = NAN;
    return good ? fmi2OK : fmi2Error;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    if (!(*state = malloc(sizeof(State)))) return fmi2Error;
    memcpy(*state, &((Hexapod *)c)->state, sizeof(State));
    return fmi2OK;
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    memcpy(&((Hexapod *)c)->state, state, sizeof(State));
    return fmi2OK;
}
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    free(*state);
    *state = 0;
    return (void)c, fmi2OK;
}
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    *size = sizeof(State);
    return (void)c, (void)state, fmi2OK;
}
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    memcpy(bytes, state, size);
    return (void)c, fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    if (size != sizeof(State) || !(*state = malloc(size))) return fmi2Error;
    memcpy(*state, bytes, size);
    return (void)c, fmi2OK;
}

/* What this FMU cannot do. */
fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[]) { return (void)c, (void)vr, (void)n, (void)value, fmi2Error; }
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String value[]) { return (void)c, (void)vr, (void)n, (void)value, fmi2Error; }
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference u[], size_t nu, const fmi2ValueReference k[], size_t nk, const fmi2Real dk[], fmi2Real du[]) {
    return (void)c, (void)u, (void)nu, (void)k, (void)nk, (void)dk, (void)du, fmi2Error;
}
fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer o[], const fmi2Real v[]) { return (void)c, (void)vr, (void)n, (void)o, (void)v, fmi2Error; }
fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer o[], fmi2Real v[]) { return (void)c, (void)vr, (void)n, (void)o, (void)v, fmi2Error; }
fmi2Status fmi2CancelStep(fmi2Component c) { return (void)c, fmi2Error; }
fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind k, fmi2Status *v) { return (void)c, (void)k, (void)v, fmi2Error; }
fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind k, fmi2Real *v) { return (void)c, (void)k, (void)v, fmi2Error; }
fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind k, fmi2Integer *v) { return (void)c, (void)k, (void)v, fmi2Error; }
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind k, fmi2Boolean *v) { return (void)c, (void)k, (void)v, fmi2Error; }
fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind k, fmi2String *v) { return (void)c, (void)k, (void)v, fmi2Error; }
