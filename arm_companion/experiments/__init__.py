"""Questions that a researcher puts to the model, and the paper's experiments repeated with it.

`case` asks one equilibrium, `paper` holds the paper's configuration-space stiffness as printed and as corrected,
`stiffness_test` and `perching` repeat the two experiments of Zhao et al. (IDETC 2022), `figures` draws them.
"""
