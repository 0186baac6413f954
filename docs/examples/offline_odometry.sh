#!/bin/sh
# A program that reads a whole log and writes a trajectory: the log's odometry, moved to the start.
#
#   estima run sensors=hokuyo estimator=offline \
#     'estimator.command=[sh,docs/examples/offline_odometry.sh,"{log}","{start}","{out}"]'
#
# {log} is a CARMEN log (ODOM x y heading ... stamp), {start} begins with a line `x y heading`, {out}
# is a TUM trajectory (stamp x y z qx qy qz qw).
log=$1 start=$2 out=$3
awk '
  NR == FNR { if (FNR == 1) { x0 = $1; y0 = $2; h0 = $3 } next }
  $1 == "ODOM" {
    heading = h0 + $4
    printf "%.17g %.17g %.17g 0 0 0 %.17g %.17g\n", $8,
      x0 + cos(h0) * $2 - sin(h0) * $3, y0 + sin(h0) * $2 + cos(h0) * $3,
      sin(heading / 2), cos(heading / 2)
  }' "$start" "$log" > "$out"
