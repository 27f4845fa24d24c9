/* The M4010's frames in C, as a C++ service would do them: the peer of bench_dex1_serial.py.
 * Written from docs/sources/unitree-dex.md#g; little-endian hosts only. */
#include "motor_crc.h"

/* values: tau, dq, q, kp, kd of the joint; factors: their counts per SI unit */
void pack(uint8_t *frame, int mode, const double *values, const double *factors) {
    int16_t tor = (int16_t)within(values[0] * factors[0], -32768, 32767);
    int16_t spd = (int16_t)within(values[1] * factors[1], -32768, 32767);
    int32_t pos = within(values[2] * factors[2], -2147483648.0, 2147483647.0);
    uint16_t kp = (uint16_t)within(values[3] * factors[3], 0, 65535);
    uint16_t kd = (uint16_t)within(values[4] * factors[4], 0, 65535);
    frame[0] = 0xFE, frame[1] = 0xEE, frame[2] = (uint8_t)mode, frame[3] = 0;
    memcpy(frame + 4, &tor, 2), memcpy(frame + 6, &spd, 2), memcpy(frame + 8, &pos, 4);
    memcpy(frame + 12, &kp, 2), memcpy(frame + 14, &kd, 2);
    uint32_t crc = crc_words(frame, 4);
    memcpy(frame + 16, &crc, 4);
}

/* out: q, dq, tau of the joint; 0 if the frame is not one */
int parse(const uint8_t *frame, const double *factors, double *out) {
    uint32_t crc;
    int16_t tor, spd;
    int32_t pos;
    memcpy(&crc, frame + 22, 4);
    if (frame[0] != 0xFC || frame[1] != 0xEE || crc != crc_words(frame + 2, 5)) return 0;
    memcpy(&tor, frame + 6, 2), memcpy(&spd, frame + 8, 2), memcpy(&pos, frame + 10, 4);
    out[0] = pos / factors[2], out[1] = spd / factors[1], out[2] = tor / factors[0];
    return 1;
}

/* n times, so that calling from Python does not count */
void pack_many(int n, uint8_t *frame, const double *values, const double *factors) {
    for (int i = 0; i < n; i++) {
        pack(frame, 0x91, values, factors);
        __asm__ volatile("" : : "r"(frame) : "memory");
    }
}

void parse_many(int n, const uint8_t *frame, const double *factors, double *out) {
    for (int i = 0; i < n; i++) {
        parse(frame, factors, out);
        __asm__ volatile("" : : "r"(out) : "memory");
    }
}
