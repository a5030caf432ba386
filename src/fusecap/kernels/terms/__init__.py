"""One cost term per file. Each adds to the gathered information or to H and g; returns its cost.

Costs are ½ Σ ρ(λ ‖r‖²), half of the paper's energies. Robust terms use plain iterative reweighting:
the Cauchy loss ρ(s) = log(1 + s) scales Jᵀr and JᵀJ by ρ'(s) = 1/(1 + s).
"""
