"""Constants of the studies; the rest is in conf/study/decristoforis2020/*.yaml."""

# An LMS291 has 1 degree at 75 Hz; its quarter of a degree takes four turns
TURNS_HZ, QUARTER_HZ, ONE_DEGREE_BEAMS = 75.0, 18.75, 181
HALVINGS = "halvings of the laser's 75 Hz"  # a free setting
PAPERS_OWN = ("odometry", "icp", "fusion")
CHECKED = (*PAPERS_OWN, "fusion_clone")  # also run at other rates, rays and noise
N_GEOMETRIES = 20  # of DC4
N_REPEATS = 60  # registrations of each pair of scans
N_TIMED = 1  # of which sampling is timed, which takes a thousand times as long
# As printed: the residual variance of the Hessian is taken from points, Censi's z is the last scan
PRINTED = ("hessian_points", "sampling", "censi_last")
N_STRETCH = 24  # pairs of scans on each stretch of a corridor
APART_M = 0.1  # between scans, as 0.5 m/s at 5 Hz gives
NEES_AT_M = (5.0, 20.0, 50.0, 95.0)
CONSISTENT = (0.8, 1.25)  # NEES over its degrees of freedom
PLACES = {  # where pairs of scans are taken: study, and place of its world
    "corridor": ("corridor", "corridor_bare"),
    "corner": ("corridor", "corner"),
    "curve": ("corridor", "curve"),
    "room": ("office", "room"),
}
PAIRS = ("room_small", "room_large", "corridor_small", "corridor_large")  # of bench.icp
WINDOWS_S = (1.0, 10.0)  # over which steps of registration are composed
HELD_M = 0.02  # standard deviation of a step above which the walls leave a direction free
WRONG_M = 0.1  # a registration that is farther off counts as failed
