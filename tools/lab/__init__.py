"""A lab with a real kernel: QEMU boots Debian's, and emulated devices are plugged into it."""
