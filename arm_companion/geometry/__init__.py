"""Rotations, poses, wrenches and twists: small pure functions over NumPy arrays.

Names: `T_ab` maps coordinates in frame b to coordinates in frame a, `p_a = T_ab @ p_b`. Wrenches are
`[force; torque]`, twists `[linear; angular]`.
"""
