"""Guided procedures on an arm that hangs free: what to do next, decided from what came of the last thing. Pure.

A procedure is a generator that yields `actions` and is sent what came of them: it decides, and does nothing itself. On
the bench `workshop.rig` carries actions out, in the daemon `mission.course` does, and in a test a few lines of
arithmetic.
"""
