"""Your own estimator: any object with `reset` and `step`.

This one reckons from the wheels and says that its errors grow by a fixed variance per metre. To
sweep it, or to name it on the command line, give it a YAML with `_target_` (docs/tutorial.md).
"""

import numpy as np

import estima
from sim import se2
from sim.robot.arc import arc_increment


class Simple:
    """Dead reckoning whose covariance grows by the same amount with every metre."""

    def __init__(self, variance_per_m: float) -> None:
        self.variance_per_m = variance_per_m

    def reset(self, prior: estima.Prior, rng: np.random.Generator) -> None:
        """Start from the prior; all randomness comes from `rng`."""
        if prior.mean is None or prior.covariance is None:
            raise estima.InputError("Simple needs a start pose; set prior.start=tracking")
        self.track_m = prior.robot.track_m
        self.mean, self.covariance = prior.mean.copy(), prior.covariance.copy()

    def step(self, frame: estima.Frame) -> estima.Belief:
        """Take in one Frame: its wheels, and whatever sensors fired."""
        right_m, left_m = frame.wheel_increments_m
        self.mean = se2.compose(self.mean, arc_increment(frame.wheel_increments_m, self.track_m))
        travelled_m = abs(right_m + left_m) / 2
        self.covariance = self.covariance + self.variance_per_m * travelled_m * np.eye(3)
        return estima.Belief(self.mean, self.covariance)


if __name__ == "__main__":
    recording = estima.simulate("simulation.physics=kinematic", "seed=3")
    for estimator in (Simple(variance_per_m=1e-3), "odometry"):
        row = estima.run(recording, estimator=estimator).row
        print(f"{row['choice.estimator']:<10} RMSE {row['ate_rmse_m']:.3f} m, "
              f"mean NEES {row['nees_mean']:.1f}")  # fmt: skip
