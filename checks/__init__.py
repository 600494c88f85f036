"""Long checks of the whole product: fuzzers, seeded simulation, kills, signals, a day, and a night of all."""
