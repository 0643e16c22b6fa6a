"""Mechanics of the tendon-driven continuum arm.

The research face repeats the paper's model with its errors corrected (`arc`, `statics`, `stiffness`); the
model that flies is a Kirchhoff rod with curvature modes (`rod`). Both stand behind `model.ArmModel`.

Frames: a is the arm's base, z from base to tip along the straight arm; t is the tip. Symbols are the paper's:
theta bending angle, delta angle of the bending plane, psi = (theta, delta), u = (theta cos delta,
theta sin delta), q or pull the tendon taken in (positive towards the motor), tau tension, L length, r pitch
radius, EI and GJ bending and torsional stiffness of the backbone, k_T stiffness of one tendon, T0 pretension.
"""
