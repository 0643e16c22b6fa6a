"""What is done to an arm on the bench: guided calibrations of its tendons, and jogging. Not used in flight.

A guided procedure is a generator that yields `actions` and is sent what came of them: it decides, and does nothing
itself. `rig` carries actions out on the real servo bus, a test can do so with a few lines of arithmetic.
"""
