/* The reference rig of gough's UDP protocol, on POSIX sockets: a start for firmware. It passes the tests that the emulated rig
 * passes (tests/hil/rigs/test_udp_rig.py). Replace `read_imu`, `read_encoder` and `drive`; every rig needs the rest.
 *
 *     cc -std=c11 -O2 -o reference_rig reference_rig.c && ./reference_rig [PORT [WATCHDOG_MS [ADDRESS]]]
 *
 * Port 0 takes any free one. The rig listens at 127.0.0.1, or at the ADDRESS of another interface. At SIGINT and SIGTERM it
 * ends, and prints how many datagrams it has refused in its last session and how far the legs have moved.
 */
#define _POSIX_C_SOURCE 200809L

#include "gough_rig.h"

#include <arpa/inet.h>
#include <math.h>
#include <netinet/in.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define VELOCITY_LIMIT 0.375f        /* m/s */
#define QUICK_STOP_DECELERATION 3.0f /* m/s^2 */
#define UPDATE_MS 1                  /* how often the drives are updated while no datagram arrives */

struct leg {
    uint8_t state; /* enum gough_drive */
    uint16_t code;
    float target, velocity; /* m/s */
    double moved;           /* m */
};

static struct {
    int socket;
    struct sockaddr_in peer; /* the controller of the session */
    uint32_t session;        /* 0: none */
    uint16_t version;        /* of its datagrams */
    uint32_t last;           /* sequence number of the last command */
    uint32_t refused;
    uint32_t request;
    uint32_t samples;
    int64_t commanded_ns, stepped_ns, watchdog_ns;
    struct leg leg[GOUGH_LEGS];
} rig;

static volatile sig_atomic_t ending;

static void end(int number) {
    (void)number;
    ending = 1;
}

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* Replace this: read an IMU's latest sample, and return its time. Here it is at rest, on the preset "hexapod" at home. */
static int64_t read_imu(int imu, float gyroscope[3], float accelerometer[3], float magnetometer[3]) {
    const float leg[3] = {0.0f, 4.5149f, 8.7094f}, platform[3] = {0.0f, 0.0f, 9.81f};
    for (int i = 0; i < 3; i++) {
        gyroscope[i] = 0.0f;
        accelerometer[i] = imu < GOUGH_LEGS ? leg[i] : platform[i];
        magnetometer[i] = NAN;
    }
    return now_ns();
}

/* Replace this: read a leg's encoder [m], [m/s], and return its home switch. Here the encoder counts from the start. */
static int8_t read_encoder(const struct leg *leg, double *length, float *rate) {
    *length = leg->moved;
    *rate = leg->velocity;
    return -1;
}

/* Replace this: read the IMU on the base, and return the time of its sample. Here it is at rest. */
static int64_t read_base_imu(float measurement[2][3]) {
    memset(measurement, 0, 2 * sizeof measurement[0]);
    measurement[1][2] = 9.81f;
    return now_ns();
}

/* Replace this: move a drive at a velocity [m/s], here for `period` [s]; a drive that is not `powered` holds on its brake. */
static void drive(struct leg *leg, float velocity, int powered, double period) {
    leg->velocity = powered ? velocity : 0.0f;
    leg->moved += leg->velocity * period;
}

static float limited(float value, float limit) {
    return value > limit ? limit : value < -limit ? -limit : value;
}

/* Let a drive follow, slow down, or hold for a period [s]. */
static void step(struct leg *leg, double period) {
    if (leg->state == GOUGH_FOLLOWING) {
        drive(leg, limited(leg->target, VELOCITY_LIMIT), 1, period);
        return;
    }
    if (leg->state == GOUGH_QUICK_STOPPING || leg->state == GOUGH_FAULTY) {
        float slower = QUICK_STOP_DECELERATION * (float)period;
        drive(leg, leg->velocity - limited(leg->velocity, slower), leg->velocity != 0.0f, period);
        if (leg->state == GOUGH_QUICK_STOPPING && leg->velocity == 0.0f)
            leg->state = GOUGH_READY;
        return;
    }
    drive(leg, 0.0f, 0, period);
}

/* Update the drives until now; without a command for too long they stop by themselves, with a fault. */
static void update_drives(int64_t now) {
    double period = 1e-9 * (double)(now - rig.stepped_ns);
    int silent = now - rig.commanded_ns > rig.watchdog_ns;
    rig.stepped_ns = now;
    for (int k = 0; k < GOUGH_LEGS; k++) {
        struct leg *leg = &rig.leg[k];
        step(leg, period);
        if (silent && (leg->state == GOUGH_FOLLOWING || leg->state == GOUGH_QUICK_STOPPING)) {
            leg->state = GOUGH_FAULTY;
            leg->code = GOUGH_WATCHDOG_CODE;
        }
    }
}

/* Apply a command to a drive. A fault stays until it is reset, at rest and with a request to brake. */
static void request(struct leg *leg, const struct gough_command *command, float velocity) {
    leg->target = velocity;
    if (leg->state == GOUGH_FAULTY) {
        if (command->reset != 0 && command->request == GOUGH_BRAKED && leg->velocity == 0.0f) {
            leg->state = GOUGH_READY;
            leg->code = 0;
        }
    } else if (command->request == GOUGH_BRAKED) {
        leg->state = GOUGH_READY;
    } else if (command->request == GOUGH_ENABLED && leg->state == GOUGH_READY) {
        leg->state = GOUGH_FOLLOWING;
    } else if (command->request == GOUGH_QUICK_STOP && leg->state == GOUGH_FOLLOWING) {
        leg->state = GOUGH_QUICK_STOPPING;
    }
}

static int is_moving(void) {
    for (int k = 0; k < GOUGH_LEGS; k++)
        if (rig.leg[k].state == GOUGH_FOLLOWING || rig.leg[k].velocity != 0.0f)
            return 1;
    return 0;
}

static int is_same(const struct sockaddr_in *one, const struct sockaddr_in *other) {
    return one->sin_addr.s_addr == other->sin_addr.s_addr && one->sin_port == other->sin_port;
}

static void answer_to(const struct sockaddr_in *to, const void *datagram, size_t length) {
    /* The controller asks again for a lost answer. */
    (void)sendto(rig.socket, datagram, length, MSG_DONTWAIT, (const struct sockaddr *)to, sizeof *to);
}

/* Begin a session, or welcome its controller again. A moving rig has one controller. */
static int take_hello(const struct gough_hello *hello, const struct sockaddr_in *sender, int64_t now) {
    int again = hello->head.session == rig.session && is_same(sender, &rig.peer);
    if (hello->head.session == 0 || hello->period_us == 0 || (!again && (is_moving() || hello->head.session == rig.session)))
        return 0;
    if (!again) {
        rig.peer = *sender;
        rig.session = hello->head.session;
        rig.version = hello->head.version;
        rig.last = rig.refused = 0;
        rig.commanded_ns = now;
        /* At least three periods, for slow controllers. */
        if (rig.watchdog_ns < 3000 * (int64_t)hello->period_us)
            rig.watchdog_ns = 3000 * (int64_t)hello->period_us;
    }
    struct gough_welcome welcome = {.watchdog_us = (uint32_t)(rig.watchdog_ns / 1000)};
    memcpy(welcome.name, "gough reference rig", sizeof "gough reference rig");
    memcpy(welcome.firmware, "1", sizeof "1");
    gough_finish(&welcome, GOUGH_WELCOME_LENGTH, GOUGH_WELCOME, rig.version, rig.session, 0, now);
    answer_to(sender, &welcome, GOUGH_WELCOME_LENGTH);
    return 1;
}

/* Apply a command, sample, answer. */
static int take_command(const struct gough_command *command, const struct sockaddr_in *sender, int64_t now) {
    if (rig.session == 0 || !is_same(sender, &rig.peer) || command->head.session != rig.session ||
        command->head.version != rig.version ||
        (int32_t)(command->head.sequence - rig.last) <= 0 || command->request > GOUGH_QUICK_STOP)
        return 0;
    for (int k = 0; k < GOUGH_LEGS; k++)
        if (!isfinite(command->velocity[k]))
            return 0;
    rig.last = command->head.sequence;
    rig.commanded_ns = now;
    for (int k = 0; k < GOUGH_LEGS; k++) {
        request(&rig.leg[k], command, command->velocity[k]);
        step(&rig.leg[k], 0.0);
    }
    struct gough_measurement answer = {.refused = rig.refused};
    rig.samples++;
    for (int k = 0; k < GOUGH_IMUS; k++) {
        answer.sample_ns[k] =
            read_imu(k, answer.measurement[0][k], answer.measurement[1][k], answer.measurement[2][k]);
        answer.sample_number[k] = rig.samples;
    }
    for (int k = 0; k < GOUGH_LEGS; k++) {
        answer.drive[k] = rig.leg[k].state;
        answer.code[k] = rig.leg[k].code;
        answer.velocity[k] = rig.leg[k].velocity;
    }
    gough_finish(&answer, GOUGH_MEASUREMENT_LENGTH, GOUGH_MEASUREMENT, rig.version, rig.session, rig.last, now);
    uint8_t datagram[GOUGH_MEASUREMENT_LENGTH + GOUGH_LENGTHS_LENGTH + GOUGH_BASE_IMU_LENGTH];
    size_t length = GOUGH_MEASUREMENT_LENGTH;
    memcpy(datagram, &answer, length);
    if (rig.version >= GOUGH_WITH_LENGTHS) {
        struct gough_lengths lengths = {.reserved = {0, 0}};
        for (int k = 0; k < GOUGH_LEGS; k++)
            lengths.home[k] = read_encoder(&rig.leg[k], &lengths.length[k], &lengths.rate[k]);
        gough_seal(&lengths, GOUGH_LENGTHS_LENGTH);
        memcpy(datagram + length, &lengths, GOUGH_LENGTHS_LENGTH);
        length += GOUGH_LENGTHS_LENGTH;
    }
    if (rig.version >= GOUGH_WITH_BASE_IMU) {
        struct gough_base_imu base = {.sample_number = rig.samples};
        base.sample_ns = read_base_imu(base.measurement);
        gough_seal(&base, GOUGH_BASE_IMU_LENGTH);
        memcpy(datagram + length, &base, GOUGH_BASE_IMU_LENGTH);
        length += GOUGH_BASE_IMU_LENGTH;
    }
    answer_to(sender, datagram, length);
    return 1;
}

/* Read a datagram if there is one; an invalid one is counted and has no other effect. */
static void receive(void) {
    union {
        struct gough_hello hello;
        struct gough_command command;
        uint8_t bytes[GOUGH_MEASUREMENT_LENGTH];
    } datagram;
    struct sockaddr_in sender;
    socklen_t size = sizeof sender;
    ssize_t length = recvfrom(rig.socket, &datagram, sizeof datagram, MSG_DONTWAIT, (struct sockaddr *)&sender, &size);
    int64_t now = now_ns();
    /* At each turn, so that no flood of datagrams blocks the watchdog. */
    update_drives(now);
    if (length < 0)
        return;
    int taken = 0;
    if (gough_check(&datagram, (size_t)length, GOUGH_HELLO_LENGTH, GOUGH_HELLO))
        taken = take_hello(&datagram.hello, &sender, now);
    else if (gough_check(&datagram, (size_t)length, GOUGH_COMMAND_LENGTH, GOUGH_COMMAND))
        taken = take_command(&datagram.command, &sender, now);
    rig.refused += !taken;
}

int main(int count, char **arguments) {
    struct sockaddr_in address = {.sin_family = AF_INET};
    socklen_t size = sizeof address;
    address.sin_port = htons((uint16_t)(count > 1 ? atoi(arguments[1]) : GOUGH_PORT));
    rig.watchdog_ns = 1000000 * (int64_t)(count > 2 ? atoi(arguments[2]) : 30);
    const char *host = count > 3 ? arguments[3] : "127.0.0.1";
    if (count > 4 || rig.watchdog_ns <= 0 || inet_pton(AF_INET, host, &address.sin_addr) != 1) {
        fprintf(stderr, "usage: %s [PORT [WATCHDOG_MS [ADDRESS]]]\n", arguments[0]);
        return 2;
    }
    rig.socket = socket(AF_INET, SOCK_DGRAM, 0);
    if (rig.socket < 0 || bind(rig.socket, (struct sockaddr *)&address, size) != 0 ||
        getsockname(rig.socket, (struct sockaddr *)&address, &size) != 0) {
        perror("cannot listen");
        return 1;
    }
    struct sigaction action = {.sa_handler = end};
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    for (int k = 0; k < GOUGH_LEGS; k++)
        rig.leg[k].state = GOUGH_READY;
    rig.stepped_ns = now_ns();
    printf("the reference rig listens at port %d\n", ntohs(address.sin_port));
    fflush(stdout);
    while (!ending) {
        struct pollfd readable = {rig.socket, POLLIN, 0};
        poll(&readable, 1, UPDATE_MS);
        receive();
    }
    printf("%u datagrams refused; the legs have moved by", (unsigned)rig.refused);
    for (int k = 0; k < GOUGH_LEGS; k++)
        printf(" %.6f", rig.leg[k].moved);
    printf(" m\n");
    close(rig.socket);
    return 0;
}
