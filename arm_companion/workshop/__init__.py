"""What is done to an arm on the bench: guided calibrations of its tendons, and jogging. Not used in flight.

`rig` carries out on the real servo bus what the `procedures` ask for.
"""
