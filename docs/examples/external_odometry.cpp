// A program that Estima asks for its beliefs: dead reckoning in C++17, without a JSON library.
//
//   g++ -std=c++17 -O2 -o external_odometry docs/examples/external_odometry.cpp
//   estima run estimator=external 'estimator.command=[./external_odometry]'
//
// It reads one JSON message a line, and answers each with one line; docs/programs.md is the protocol.
// A key is written once in a message, or first where it is at the top, so finding it is enough.

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <string>
#include <vector>

// The numbers that follow a key, up to `count`, whatever the brackets; null is NaN (no return).
std::vector<double> numbers(const std::string& line, const std::string& key, std::size_t count) {
  std::vector<double> found;
  std::size_t at = line.find("\"" + key + "\":");
  if (at == std::string::npos) return found;
  const char* next = line.c_str() + at + key.size() + 3;
  while (*next && found.size() < count) {
    char* end = nullptr;
    if (*next == '[' || *next == ']' || *next == ',') {
      ++next;
    } else if (std::string(next, 4) == "null") {
      found.push_back(std::nan(""));
      next += 4;
    } else {
      found.push_back(std::strtod(next, &end));
      if (end == next) break;
      next = end;
    }
  }
  return found;
}

int main() {
  std::string line;
  double track_m = 1.0, x = 0.0, y = 0.0, heading = 0.0, variance = 0.0;
  std::vector<double> start(9, 0.0);
  while (std::getline(std::cin, line)) {
    if (line.find("\"type\":\"reset\"") != std::string::npos) {
      track_m = numbers(line, "track_m", 1).at(0);
      std::vector<double> mean = numbers(line, "mean", 3);
      x = mean.at(0), y = mean.at(1), heading = mean.at(2);
      start = numbers(line, "covariance", 9);
      std::puts("{}");
    } else if (line.find("\"type\":\"frame\"") != std::string::npos) {
      std::vector<double> wheels = numbers(line, "wheel_increments_m", 2);  // right, left
      double forward_m = (wheels[0] + wheels[1]) / 2, turn_rad = (wheels[0] - wheels[1]) / track_m;
      x += forward_m * std::cos(heading + turn_rad / 2);
      y += forward_m * std::sin(heading + turn_rad / 2);
      heading += turn_rad;
      variance += 1e-6 * std::fabs(forward_m);  // a guess: 1 mm^2 and 1 mrad^2 a metre
      const std::vector<double>& c = start;
      std::printf("{\"mean\":[%.17g,%.17g,%.17g],\"covariance\":", x, y, heading);
      std::printf("[[%.17g,%.17g,%.17g],", c[0] + variance, c[1], c[2]);
      std::printf("[%.17g,%.17g,%.17g],", c[3], c[4] + variance, c[5]);
      std::printf("[%.17g,%.17g,%.17g]]}\n", c[6], c[7], c[8] + variance);
    } else {
      std::puts("{}");  // finish: there is no revised trajectory
    }
    std::fflush(stdout);
  }
}
