static void read_registers(int *values) {
    unsigned char frame[29], *row; /* a row is a letter, its argument, a place in the frame, and an index */
    for (row = READS; row < READS + sizeof READS; row += 4) {
        unsigned char request[] = {row[1] ? 3 : 2, row[0], row[1]};
        if (row == READS || row[0] != row[-4] || row[1] != row[-3]) {
            transfer(0x31, request, request[0], NULL, 0);
            transfer(0x31, NULL, 0, frame, row[1] ? 7 : 29);
        }
        values[row[3]] = (short)(frame[row[2]] | frame[row[2] + 1] << 8);
    }
}

static void set(int motor, int first, int n_bytes, int value) { /* the highest byte first */
    while (n_bytes--)
        transfer(0x29 + motor, (unsigned char[]){first + n_bytes, value >> 8 * n_bytes}, 2, NULL, 0);
}

static void drive(int left, int right) { set(0, 0x2F, 4, left), set(1, 0x2F, 4, right); }

static void start(void) { /* the left motor inverted, speed control, all ultrasonic sensors */
    int motor;
    bus = open(BUS, O_RDWR);
    for (motor = 0; motor < 2; motor++)
        set(motor, 0x2B, 1, motor ? 0 : 128), set(motor, 0x28, 1, 1), set(motor, 0x2C, 1, 3);
    drive(0, 0);
    transfer(0x31, (unsigned char[]){5, 'C', 0, 0, 31}, 5, NULL, 0);
}
