"""A sweep to a DataFrame and a plot: how far dead reckoning errs as the wheels slip more.

Rows go to results/runs/slip below the current folder, and the picture to sweep.png. Started again,
it computes only what is missing.
"""

import estima

table = estima.sweep(
    "simulation.physics=kinematic",
    "route=linear_4",
    "robot.kr=1e-6,1e-5,1e-4",
    "robot.kl=${robot.kr}",
    "seed=range(0,5)",
    name="slip",
)
print(table.groupby("robot.kr")[["ate_rmse_m", "nees_mean"]].mean())
estima.plot(table, x="robot.kr", y="ate_rmse_m", path="sweep.png")
