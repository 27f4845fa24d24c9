/* The Dex3-1's frames in C, as a C++ program after the manual would do them: the peer of
 * bench_dex3_usb_codec.py. Written from docs/dex3-protocol.md; little-endian hosts only. */
#include "motor_crc.h"

enum { BUSES = 5, MOTORS = 7, SENSORS = 9, BUFFER = 240, COMMAND = 1234, STATE = 1270 };

static const int motor_bus[MOTORS] = {0, 0, 0, 1, 1, 2, 2};
static const int motor_id[MOTORS] = {0, 1, 2, 0, 1, 0, 1};
static const int sensor_bus[SENSORS] = {0, 0, 1, 1, 2, 2, 3, 3, 3};
static const int sensor_id[SENSORS] = {0, 1, 0, 1, 0, 1, 0, 1, 2};

static void put(uint8_t *at, const void *value, int size) { memcpy(at, value, size); }

/* values: tau, dq, q, kp, kd of each motor; factors: their counts per SI unit */
void encode(const double *values, const double *factors, int status, int timeout, uint8_t *out) {
    uint32_t sizes[BUSES] = {0};
    memset(out, 0, COMMAND);
    out[0] = 0xFE;
    out[1] = 0xFD;
    for (int i = 0; i < MOTORS; i++) {
        const double *v = values + 5 * i, *f = factors + 5 * i;
        uint8_t *p = out + 26 + motor_bus[i] * BUFFER + sizes[motor_bus[i]];
        int16_t tor = within(v[0] * f[0], -32768, 32767);
        int16_t spd = within(v[1] * f[1], -32768, 32767);
        int32_t pos = within(v[2] * f[2], -2147483648.0, 2147483647.0);
        int16_t kp = within(v[3] * f[3], 0, 32767), kd = within(v[4] * f[4], 0, 32767);
        uint32_t crc;
        p[0] = 0xFE;
        p[1] = 0xEE;
        p[2] = (uint8_t)(motor_id[i] | status << 4 | timeout << 7);
        put(p + 4, &tor, 2);
        put(p + 6, &spd, 2);
        put(p + 8, &pos, 4);
        put(p + 12, &kp, 2);
        put(p + 14, &kd, 2);
        crc = crc_words(p, 4);
        put(p + 16, &crc, 4);
        sizes[motor_bus[i]] += 20;
    }
    put(out + 6, sizes, sizeof sizes);
    uint32_t crc = crc_words(out + 2, 307);
    put(out + 1230, &crc, 4);
}

static int owner(const int *buses, const int *ids, int n, int bus, int id) {
    for (int i = 0; i < n; i++)
        if (buses[i] == bus && ids[i] == id) return i;
    return -1;
}

/* per motor: q, dq, tau, case, winding, voltage, status, error; units: SI per count of the first
 * three. Pressures in Pa and temperatures per sensor. Returns the packets that were right, or -1. */
int decode(const uint8_t *in, const double *units, double *motors, double *pressures,
           double *temperatures, double *tail) {
    uint32_t crc, sizes[BUSES];
    int good = 0;
    memcpy(&crc, in + 1266, 4);
    if (in[0] != 0xFC || in[1] != 0xFD || crc_words(in + 2, 316) != crc) return -1;
    memcpy(sizes, in + 6, sizeof sizes);
    for (int bus = 0; bus < BUSES; bus++) {
        const uint8_t *p = in + 26 + bus * BUFFER, *end = p + sizes[bus];
        if (sizes[bus] > BUFFER) return -1;
        while (p + 26 <= end) {
            if (p[0] == 0xFC && p[1] == 0xEE) {
                int16_t torque, speed;
                int32_t pos;
                uint32_t error;
                int i = owner(motor_bus, motor_id, MOTORS, bus, p[2] & 15);
                memcpy(&crc, p + 22, 4);
                if (i >= 0 && crc_words(p + 2, 5) == crc) {
                    double *m = motors + 8 * i;
                    const double *u = units + 3 * i;
                    memcpy(&torque, p + 6, 2);
                    memcpy(&speed, p + 8, 2);
                    memcpy(&pos, p + 10, 4);
                    memcpy(&error, p + 14, 4);
                    m[0] = pos * u[0];
                    m[1] = speed * u[1];
                    m[2] = torque * u[2];
                    m[3] = (int8_t)p[3];
                    m[4] = p[4];
                    m[5] = p[5] * 0.5;
                    m[6] = p[2] >> 4 & 7;
                    m[7] = error;
                    good++;
                }
                p += 26;
            } else if (p[0] == 0x7E && p[1] == 0xE7 && p + 44 <= end) {
                int i = owner(sensor_bus, sensor_id, SENSORS, bus, p[2] & 15);
                memcpy(&crc, p + 40, 4);
                if (i >= 0 && crc_words(p, 10) == crc) {
                    for (int k = 0; k < 12; k++) {
                        uint16_t count;
                        memcpy(&count, p + 4 + 2 * k, 2);
                        pressures[12 * i + k] = count == 30000 ? 0.0 / 0.0 : count * 8.0;
                        temperatures[12 * i + k] = (int8_t)p[28 + k];
                    }
                    good++;
                }
                p += 44;
            } else {
                p++;
            }
        }
    }
    for (int k = 0; k < 4; k++) {
        uint16_t count;
        memcpy(&count, in + 1226 + 2 * k, 2);
        tail[k] = count / 65536.0 * 3.3 * (k == 3 ? 10.0 : 21.0);
    }
    for (int k = 0; k < 6; k++) {
        int16_t count;
        memcpy(&count, in + 1234 + 2 * k, 2);
        tail[4 + k] = count / 100.0;
    }
    return good;
}

/* The loops are here, so that no call from Python is in the figure. */
uint32_t encode_many(int n, double *values, const double *factors, uint8_t *out) {
    uint32_t sum = 0;
    for (int i = 0; i < n; i++) {
        values[2] += 1e-6;
        encode(values, factors, 1, 1, out);
        sum += out[1230];
    }
    return sum;
}

int decode_many(int n, const uint8_t *in, const double *units, double *motors, double *pressures,
                double *temperatures, double *tail) {
    int good = 0;
    for (int i = 0; i < n; i++)
        good += decode(in, units, motors, pressures, temperatures, tail);
    return good;
}

uint32_t crc_many(int n, uint8_t *data, int words) {
    uint32_t sum = 0;
    for (int i = 0; i < n; i++) {
        data[0] ^= 1;
        sum += crc_words(data, words);
    }
    return sum;
}
