"""Reproduction of the results of the thesis on re-synthesised runs, beside the published ones.

Source of all published numbers: D. M. D. da Silva, "Comparative study of optimization algorithms
for parameter identification of the sigmoid model in MR dampers", University of Brasília, 2023.
"""
