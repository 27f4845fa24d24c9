/* The checksum of Unitree's motors, table-driven, for the C peers of the codec benchmarks. */
#include <stdint.h>
#include <string.h>

static uint32_t table[256];

void prepare(void) {
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t c = i << 24;
        for (int bit = 0; bit < 8; bit++) c = c & 0x80000000u ? (c << 1) ^ 0x04C11DB7u : c << 1;
        table[i] = c;
    }
}

uint32_t crc_words(const uint8_t *data, int words) {
    uint32_t crc = 0xFFFFFFFFu;
    for (int i = 0; i < words; i++) {
        uint32_t word;
        memcpy(&word, data + 4 * i, 4);
        for (int shift = 24; shift >= 0; shift -= 8)
            crc = (crc << 8) ^ table[((crc >> 24) ^ (word >> shift)) & 0xFF];
    }
    return crc;
}

static int32_t within(double value, double low, double high) {
    return (int32_t)(value < low ? low : value > high ? high : value);
}
