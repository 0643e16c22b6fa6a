"""The simulated world: plant, autopilot stand-in, servo emulator, and the flights through it."""
