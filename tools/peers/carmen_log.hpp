// What the programs of peers read and write: a CARMEN log, a start, TUM lines.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

struct Pose {  // m, m, rad
  double x = 0.0, y = 0.0, heading = 0.0;
};

inline Pose compose(const Pose& a, const Pose& b) {
  const double c = std::cos(a.heading), s = std::sin(a.heading);
  return {a.x + c * b.x - s * b.y, a.y + s * b.x + c * b.y, a.heading + b.heading};
}

inline Pose between(const Pose& a, const Pose& b) {  // b as seen from a
  const double c = std::cos(a.heading), s = std::sin(a.heading);
  const double dx = b.x - a.x, dy = b.y - a.y;
  return {c * dx + s * dy, -s * dx + c * dy, std::remainder(b.heading - a.heading, 2.0 * M_PI)};
}

struct Scan {
  double stamp;
  Pose odometry, mount;  // of the robot in odom, of the laser on the robot
  double first_rad, step_rad, max_range_m, sigma_m;
  std::vector<double> ranges_m;

  bool seen(std::size_t i) const { return ranges_m[i] > 0.0 && ranges_m[i] < max_range_m; }
};

[[noreturn]] inline void fail(const std::string& why) {
  std::cerr << why << "\n";
  std::exit(1);
}

inline std::vector<Scan> read_log(const std::string& path) {
  std::ifstream file(path);
  if (!file) fail(path + ": cannot read it");
  std::vector<Scan> scans;
  std::string line;
  while (std::getline(file, line)) {
    std::istringstream words(line);
    std::string kind;
    words >> kind;
    if (kind != "ROBOTLASER1") continue;
    Scan scan;
    double type, fov, remission, n_remissions, rest;
    std::size_t n = 0;
    words >> type >> scan.first_rad >> fov >> scan.step_rad >> scan.max_range_m >> scan.sigma_m >>
        remission >> n;
    for (std::size_t i = 0; i < n && words; ++i) {
      double range = 0.0;
      words >> range;
      scan.ranges_m.push_back(range);
    }
    Pose laser;
    words >> n_remissions >> laser.x >> laser.y >> laser.heading;
    words >> scan.odometry.x >> scan.odometry.y >> scan.odometry.heading;
    for (int i = 0; i < 5; ++i) words >> rest;
    words >> scan.stamp;
    if (!words) fail(path + ": a ROBOTLASER1 line is cut short");
    scan.mount = between(scan.odometry, laser);
    scans.push_back(scan);
  }
  if (scans.empty()) fail(path + ": no ROBOTLASER1 lines");
  return scans;
}

// Whether the file holds a start: x y heading, and the rows of its covariance.
inline bool read_start(const std::string& path, Pose& mean, double (&covariance)[3][3]) {
  std::ifstream file(path);
  if (!(file >> mean.x >> mean.y >> mean.heading)) return false;
  for (auto& row : covariance)
    for (double& value : row)
      if (!(file >> value)) fail(path + ": the covariance is cut short");
  return true;
}

inline void write_pose(std::ofstream& out, double stamp, const Pose& pose) {
  char line[200];
  std::snprintf(line, sizeof line, "%.9f %.17g %.17g 0 0 0 %.17g %.17g", stamp, pose.x, pose.y,
                std::sin(pose.heading / 2), std::cos(pose.heading / 2));
  out << line;
}

// The upper triangle that may follow a pose; `at(row, column)` gives its values.
template <class Matrix>
void write_covariance(std::ofstream& out, const Matrix& at) {
  char number[30];
  for (int row = 0; row < 3; ++row)
    for (int column = row; column < 3; ++column) {
      std::snprintf(number, sizeof number, " %.17g", at(row, column));
      out << number;
    }
}
