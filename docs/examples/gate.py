"""A gate: accept today's errors as the baseline, and be stopped when a change makes them worse.

In a project of one's own the suite is a file under version control, and CI runs
`estima check --suite gate.yaml`; see docs/regression.md. Writes gate.yaml and gate.baselines/ into
the current folder.
"""

from pathlib import Path

from experiments.gate.report import run_check

SUITE = """\
first_seed: 0
recordings:
  room:
    count: 8
    overrides: [simulation.physics=kinematic, route.distance_m=5]
estimators:
  odometry:
    recordings: room
    repeats: [1, 1] # of the baseline, of a check: one is enough for what draws nothing at random
    overrides: [prior.track_m={track_m}]
"""
suite = Path("gate.yaml")

suite.write_text(SUITE.format(track_m=0.19))
run_check(str(suite), "the first baseline", release=True)
print("worse" if run_check(str(suite), None) else "as good as the baseline")

suite.write_text(SUITE.format(track_m=0.17))  # a change that does harm: a track 2 cm too narrow
print("worse" if run_check(str(suite), None) else "as good as the baseline")
