/* Datagrams of gough's UDP rig, versions 1 to 3, for firmware: C11, freestanding, for little-endian machines. docs/rigs.md describes
 * the protocol, and hil/rigs/udp/reference_rig.c is a rig to start from.
 *
 * Every field is aligned to its size, so the structures need no packing. Padding at their end makes some longer in memory than
 * on the wire: a datagram ends with `crc`, and its length is GOUGH_..._LENGTH, not sizeof. SI units.
 *
 * A session has the version of its hello. From version 2 on, a struct gough_lengths follows each measurement; in version 3, a
 * struct gough_base_imu follows that. A rig without encoders and without an IMU on its base may know version 1 only.
 */
#ifndef GOUGH_RIG_H
#define GOUGH_RIG_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the datagrams are little-endian: swap the bytes of every field on this machine"
#endif

#define GOUGH_LEGS 6
#define GOUGH_IMUS 7

#define GOUGH_MAGIC 0x48475547u /* the bytes "GUGH" */
#define GOUGH_VERSION 1u
#define GOUGH_WITH_LENGTHS 2u  /* the version with lengths */
#define GOUGH_WITH_BASE_IMU 3u /* the version with an IMU on the base besides */
#define GOUGH_PORT 47100

enum gough_kind { GOUGH_HELLO = 1, GOUGH_WELCOME, GOUGH_COMMAND, GOUGH_MEASUREMENT };

/* Request to the drives: hold on the brakes; follow the velocities; stop by themselves and then hold. */
enum gough_request { GOUGH_BRAKED, GOUGH_ENABLED, GOUGH_QUICK_STOP };

/* State of a drive. GOUGH_OFF: it is not ready, for example without power. */
enum gough_drive { GOUGH_FOLLOWING, GOUGH_READY, GOUGH_OFF, GOUGH_QUICK_STOPPING, GOUGH_FAULTY };

#define GOUGH_WATCHDOG_CODE 0x8130u /* fault code: no command for too long (CiA 402: life guarding) */

struct gough_head {
    uint32_t magic;
    uint16_t version;
    uint16_t kind;
    uint32_t session;  /* chosen by the controller, never 0 */
    uint32_t sequence; /* of commands, from 1; an answer repeats its command's */
    int64_t time_ns;   /* on the sender's own clock */
};

/* From the controller: begin a session. */
struct gough_hello {
    struct gough_head head;
    uint32_t period_us; /* between commands, never 0 */
    uint32_t reserved;
    uint32_t crc;
};

/* From the rig: its identity. */
struct gough_welcome {
    struct gough_head head;
    uint32_t watchdog_us; /* time without a command after which the drives stop; at least three periods */
    uint32_t truthful;    /* 0; 1 for an emulated rig, which appends a struct gough_truth to its measurements */
    uint8_t name[32];     /* ASCII, padded with zeros */
    uint8_t firmware[16];
    uint32_t crc;
};

/* From the controller, once per period. */
struct gough_command {
    struct gough_head head;
    uint32_t request;           /* enum gough_request */
    uint32_t reset;             /* not 0: reset the drives' faults */
    float velocity[GOUGH_LEGS]; /* positive extends the leg [m/s] */
    uint32_t reserved;
    uint32_t crc;
};

/* From the rig, once per command. */
struct gough_measurement {
    struct gough_head head;
    int64_t sample_ns[GOUGH_IMUS];      /* time of each IMU's sample, on the rig's clock */
    uint32_t sample_number[GOUGH_IMUS]; /* the same when a sample is repeated */
    uint32_t refused;                   /* datagrams, since the session began */
    uint8_t drive[GOUGH_LEGS];          /* enum gough_drive */
    uint8_t reserved[2];
    uint16_t code[GOUGH_LEGS];  /* fault codes, 0 without a fault */
    float velocity[GOUGH_LEGS]; /* velocities of the drives after limits [m/s] */
    /* Angular velocity [rad/s], specific force [m/s^2], magnetic field [uT]; NaN without a sensor. The last IMU is the
     * platform's. */
    float measurement[3][GOUGH_IMUS][3];
    uint32_t crc;
};

/* From version 2 on, what the encoders read; it follows a measurement. */
struct gough_lengths {
    double length[GOUGH_LEGS]; /* [m], positive when the leg extends, from any zero; NaN without an encoder */
    float rate[GOUGH_LEGS];    /* [m/s]; NaN without an encoder */
    int8_t home[GOUGH_LEGS];   /* home switches: 1 beyond the switch, 0 before it, -1 without one */
    uint8_t reserved[2];
    uint32_t crc; /* of this structure alone */
};

/* In version 3, the IMU on the base; it follows the lengths. */
struct gough_base_imu {
    int64_t sample_ns;       /* time of its sample, on the rig's clock */
    uint32_t sample_number;  /* the same when a sample is repeated */
    float measurement[2][3]; /* angular velocity [rad/s] and specific force [m/s^2] along the axes of the base; NaN without it */
    uint32_t crc;            /* of this structure alone */
};

/* An emulated rig appends it to all that. */
struct gough_truth {
    double truth[19];
    uint32_t reserved;
    uint32_t crc;
};

#define GOUGH_LENGTH(type) (offsetof(struct type, crc) + sizeof(uint32_t))
#define GOUGH_HELLO_LENGTH GOUGH_LENGTH(gough_hello)
#define GOUGH_WELCOME_LENGTH GOUGH_LENGTH(gough_welcome)
#define GOUGH_COMMAND_LENGTH GOUGH_LENGTH(gough_command)
#define GOUGH_MEASUREMENT_LENGTH GOUGH_LENGTH(gough_measurement)
#define GOUGH_LENGTHS_LENGTH GOUGH_LENGTH(gough_lengths)
#define GOUGH_BASE_IMU_LENGTH GOUGH_LENGTH(gough_base_imu)
#define GOUGH_TRUTH_LENGTH GOUGH_LENGTH(gough_truth)

_Static_assert(sizeof(float) == 4 && sizeof(double) == 8, "IEEE 754");
_Static_assert(sizeof(struct gough_head) == 24, "head");
_Static_assert(offsetof(struct gough_head, time_ns) == 16, "head.time_ns");
_Static_assert(offsetof(struct gough_hello, period_us) == 24, "hello.period_us");
_Static_assert(GOUGH_HELLO_LENGTH == 36, "hello");
_Static_assert(offsetof(struct gough_welcome, name) == 32, "welcome.name");
_Static_assert(offsetof(struct gough_welcome, firmware) == 64, "welcome.firmware");
_Static_assert(GOUGH_WELCOME_LENGTH == 84, "welcome");
_Static_assert(offsetof(struct gough_command, velocity) == 32, "command.velocity");
_Static_assert(GOUGH_COMMAND_LENGTH == 64, "command");
_Static_assert(offsetof(struct gough_measurement, sample_ns) == 24, "measurement.sample_ns");
_Static_assert(offsetof(struct gough_measurement, sample_number) == 80, "measurement.sample_number");
_Static_assert(offsetof(struct gough_measurement, refused) == 108, "measurement.refused");
_Static_assert(offsetof(struct gough_measurement, drive) == 112, "measurement.drive");
_Static_assert(offsetof(struct gough_measurement, code) == 120, "measurement.code");
_Static_assert(offsetof(struct gough_measurement, velocity) == 132, "measurement.velocity");
_Static_assert(offsetof(struct gough_measurement, measurement) == 156, "measurement.measurement");
_Static_assert(GOUGH_MEASUREMENT_LENGTH == 412, "measurement");
_Static_assert(offsetof(struct gough_lengths, rate) == 48, "lengths.rate");
_Static_assert(offsetof(struct gough_lengths, home) == 72, "lengths.home");
_Static_assert(GOUGH_LENGTHS_LENGTH == 84, "lengths");
_Static_assert(offsetof(struct gough_base_imu, measurement) == 12, "base_imu.measurement");
_Static_assert(GOUGH_BASE_IMU_LENGTH == 40, "base_imu");
_Static_assert(GOUGH_TRUTH_LENGTH == 160, "truth");

/* CRC-32 (IEEE 802.3, as in zlib), without a table: 8 steps a byte. */
static inline uint32_t gough_crc32(const void *data, size_t length) {
    const uint8_t *byte = data;
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < length; i++) {
        crc ^= byte[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1u ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
    }
    return crc ^ 0xFFFFFFFFu;
}

/* Whether the `received` bytes are a datagram of this kind and length, in a version that this header knows. */
static inline int gough_check(const void *data, size_t received, size_t length, enum gough_kind kind) {
    struct gough_head head;
    uint32_t crc;
    if (received != length)
        return 0;
    memcpy(&head, data, sizeof head);
    memcpy(&crc, (const uint8_t *)data + length - sizeof crc, sizeof crc);
    return head.magic == GOUGH_MAGIC && head.version >= GOUGH_VERSION && head.version <= GOUGH_WITH_BASE_IMU &&
           head.kind == kind && crc == gough_crc32(data, length - sizeof crc);
}

/* Write the CRC behind data of this length with it. */
static inline void gough_seal(void *data, size_t length) {
    uint32_t crc = gough_crc32(data, length - sizeof crc);
    memcpy((uint8_t *)data + length - sizeof crc, &crc, sizeof crc);
}

/* Write the head and the CRC of a datagram of this kind and length, whose other fields have been written. */
static inline void gough_finish(void *data, size_t length, enum gough_kind kind, uint16_t version, uint32_t session,
                                uint32_t sequence, int64_t time_ns) {
    struct gough_head head = {GOUGH_MAGIC, version, (uint16_t)kind, session, sequence, time_ns};
    memcpy(data, &head, sizeof head);
    gough_seal(data, length);
}

#endif
