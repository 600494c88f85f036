static void read_registers(int *values) {
    unsigned char bytes[256], *row, *byte; /* a row is a first register and a number of values */
    for (row = READS; row < READS + sizeof READS; row += 2) {
        transfer(0x30, row, 1, bytes, 2 * row[1]);
        for (byte = bytes; byte < bytes + 2 * row[1]; byte += 2)
            *values++ = (short)(byte[0] | byte[1] << 8);
    }
}

static void write_registers(unsigned char *message, int size) { transfer(0x30, message, size, NULL, 0); }

static void drive(int left, int right) {
    write_registers((unsigned char[]){0x18, left & 255, left >> 8 & 255, right & 255, right >> 8 & 255}, 5);
}

static void start(void) { /* gains as after a reset, all ultrasonic sensors, speed control */
    bus = open(BUS, O_RDWR);
    write_registers((unsigned char[]){0x0B, 10, 5, 1}, 4);
    write_registers((unsigned char[]){0x7A, 31}, 2);
    drive(0, 0);
    write_registers((unsigned char[]){0x17, 1}, 2);
}
