"""Questions that a researcher puts to the model, and the paper's experiments repeated with it.

`case` asks for one equilibrium, `stiffness_test` and `perching` repeat the two experiments of Zhao et al. (IDETC
2022), `figures` draws them. Nothing here reads or writes files but `figures`.
"""
