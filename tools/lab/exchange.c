/* Exchanges frames with a Dex3-1 through libusb, without Python:
 *     exchange VENDOR PRODUCT OUT IN FRAME COUNT     (numbers in hex but for COUNT)
 * FRAME is a file with a command frame. Prints the exchanges a second and the bytes of an answer.
 * The prototypes are those of libusb 1.0's API, so that no header is needed to compile it. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

typedef struct context context;
typedef struct handle handle;
int libusb_init(context **);
void libusb_exit(context *);
handle *libusb_open_device_with_vid_pid(context *, uint16_t, uint16_t);
int libusb_claim_interface(handle *, int);
int libusb_release_interface(handle *, int);
void libusb_close(handle *);
int libusb_bulk_transfer(handle *, unsigned char, unsigned char *, int, int *, unsigned);
const char *libusb_error_name(int);

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec * 1e-9;
}

static int failed(const char *what, int code)
{
    fprintf(stderr, "%s: %s\n", what, libusb_error_name(code));
    return 1;
}

int main(int argc, char **argv)
{
    unsigned char frame[2048], answer[2048];
    context *usb;
    if (argc != 7)
        return 2;
    FILE *file = fopen(argv[5], "rb");
    if (!file)
        return 2;
    int size = (int)fread(frame, 1, sizeof frame, file), count = atoi(argv[6]);
    fclose(file);
    int code = libusb_init(&usb);
    if (code)
        return failed("libusb_init", code);
    handle *hand = libusb_open_device_with_vid_pid(usb, (uint16_t)strtol(argv[1], 0, 16),
                                                   (uint16_t)strtol(argv[2], 0, 16));
    if (!hand) {
        fprintf(stderr, "no such device, or no permission\n");
        return 1;
    }
    if ((code = libusb_claim_interface(hand, 0)))
        return failed("libusb_claim_interface", code);
    unsigned char out = (unsigned char)strtol(argv[3], 0, 16);
    unsigned char in = (unsigned char)strtol(argv[4], 0, 16);
    int sent = 0, got = 0;
    double begin = now();
    for (int i = 0; i < count; i++) {
        if ((code = libusb_bulk_transfer(hand, out, frame, size, &sent, 1000)))
            return failed("write", code);
        if ((code = libusb_bulk_transfer(hand, in, answer, sizeof answer, &got, 1000)))
            return failed("read", code);
    }
    printf("%.0f exchanges/s, %d bytes out, %d in\n", count / (now() - begin), sent, got);
    libusb_release_interface(hand, 0);
    libusb_close(hand);
    libusb_exit(usb);
    return 0;
}
