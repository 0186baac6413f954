// MRPT's scan matching and its Rao-Blackwellized SLAM over a CARMEN log, for estimator=offline.
//
//   make peers                                  # needs libmrpt-slam-dev (Debian)
//   build/peers/mrpt icp|rbpf LOG START OUT SEED [KEY=VALUE ...]
//   build/peers/mrpt version
//
// LOG has ROBOTLASER1 lines (laser pose and robot pose by odometry), START the first pose, OUT gets TUM
// lines at the stamps of the scans. `icp` registers each scan against a key frame from the wheels'
// guess; its keys are members of CICP's options, and key_m and key_rad. `rbpf` has the settings of
// MRPT's grid mapping by optimal sampling; its keys are particles and resolution_m.

#include <mrpt/config/CConfigFileMemory.h>
#include <mrpt/maps/CMultiMetricMap.h>
#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/maps/CSimplePointsMap.h>
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/poses/CPosePDFGaussian.h>
#include <mrpt/random.h>
#include <mrpt/slam/CICP.h>
#include <mrpt/slam/CMetricMapBuilderRBPF.h>
#include <mrpt/version.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

using mrpt::poses::CPose2D;

struct Scan {
  double stamp;
  CPose2D odometry;
  mrpt::obs::CObservation2DRangeScan::Ptr observation;
};

[[noreturn]] void fail(const std::string& why) {
  std::cerr << why << "\n";
  std::exit(1);
}

std::vector<Scan> read_log(const std::string& path) {
  std::ifstream file(path);
  if (!file) fail(path + ": cannot read it");
  std::vector<Scan> scans;
  std::string line;
  while (std::getline(file, line)) {
    std::istringstream words(line);
    std::string kind;
    words >> kind;
    if (kind != "ROBOTLASER1") continue;
    double type, start, fov, step, max_range, accuracy, remission;
    std::size_t n = 0;
    words >> type >> start >> fov >> step >> max_range >> accuracy >> remission >> n;
    auto scan = mrpt::obs::CObservation2DRangeScan::Create();
    scan->aperture = static_cast<float>(step * (n - 1));
    scan->rightToLeft = true;
    scan->maxRange = static_cast<float>(max_range);
    scan->stdError = static_cast<float>(accuracy);
    scan->resizeScan(n);
    for (std::size_t i = 0; i < n; ++i) {
      double range = 0.0;
      words >> range;
      const bool seen = range > 0.0 && range < max_range;
      scan->setScanRange(i, static_cast<float>(seen ? range : 0.0));
      scan->setScanRangeValidity(i, seen);
    }
    double n_remissions, lx, ly, la, x, y, a, rest, stamp;
    words >> n_remissions >> lx >> ly >> la >> x >> y >> a;
    for (int i = 0; i < 5; ++i) words >> rest;
    words >> stamp;
    if (!words) fail(path + ": a ROBOTLASER1 line is cut short");
    const CPose2D robot(x, y, a);
    const CPose2D mount = CPose2D(lx, ly, la) - robot;
    scan->sensorPose =
        mrpt::poses::CPose3D(mount.x(), mount.y(), 0.25, mount.phi() + start + scan->aperture / 2);
    scan->timestamp = mrpt::Clock::fromDouble(stamp);
    scan->sensorLabel = "laser";
    scans.push_back({stamp, robot, scan});
  }
  if (scans.empty()) fail(path + ": no ROBOTLASER1 lines");
  return scans;
}

void write_pose(std::ofstream& out, double stamp, const CPose2D& pose) {
  char line[200];
  std::snprintf(line, sizeof line, "%.9f %.17g %.17g 0 0 0 %.17g %.17g\n", stamp, pose.x(), pose.y(),
                std::sin(pose.phi() / 2), std::cos(pose.phi() / 2));
  out << line;
}

double take(std::map<std::string, double>& options, const std::string& key, double otherwise) {
  const auto found = options.find(key);
  if (found == options.end()) return otherwise;
  const double value = found->second;
  options.erase(found);
  return value;
}

void check_all_taken(const std::map<std::string, double>& options) {
  if (!options.empty()) fail("unknown option " + options.begin()->first);
}

void run_icp(const std::vector<Scan>& scans, const CPose2D& start, std::ofstream& out,
             std::map<std::string, double> options) {
  mrpt::slam::CICP icp;
  auto& o = icp.options;
  o.skip_cov_calculation = true;
  o.maxIterations = static_cast<unsigned>(take(options, "maxIterations", o.maxIterations));
  o.thresholdDist = take(options, "thresholdDist", o.thresholdDist);
  o.thresholdAng = take(options, "thresholdAng", o.thresholdAng);
  o.smallestThresholdDist = take(options, "smallestThresholdDist", o.smallestThresholdDist);
  o.corresponding_points_decimation = static_cast<std::uint32_t>(
      take(options, "corresponding_points_decimation", o.corresponding_points_decimation));
  const double key_m = take(options, "key_m", 0.5), key_rad = take(options, "key_rad", 0.35);
  check_all_taken(options);
  const auto map_of = [](const Scan& scan) {
    mrpt::maps::CSimplePointsMap map;
    map.insertionOptions.minDistBetweenLaserPoints = 0.0f;
    map.insertObservation(*scan.observation);
    return map;
  };
  CPose2D pose = start, key = start;
  mrpt::maps::CSimplePointsMap reference = map_of(scans.front());
  write_pose(out, scans.front().stamp, pose);
  for (std::size_t i = 1; i < scans.size(); ++i) {
    const CPose2D predicted = pose + (scans[i].odometry - scans[i - 1].odometry);
    const mrpt::maps::CSimplePointsMap now = map_of(scans[i]);
    const auto found = icp.Align(&reference, &now, predicted - key);
    const CPose2D moved = found->getMeanVal();
    pose = std::isfinite(moved.x()) ? key + moved : predicted;
    const CPose2D since = pose - key;
    if (std::hypot(since.x(), since.y()) > key_m || std::abs(since.phi()) > key_rad) {
      key = pose;
      reference = now;
    }
    write_pose(out, scans[i].stamp, pose);
  }
}

void run_rbpf(const std::vector<Scan>& scans, const CPose2D& start, std::ofstream& out,
              std::map<std::string, double> options) {
  std::ostringstream text;
  text << "[S]\nPF_algorithm=pfOptimalProposal\nresamplingMethod=prMultinomial\nBETA=0.5\n"
          "adaptiveSampleSize=false\nsampleSize="
       << static_cast<int>(take(options, "particles", 15))
       << "\npfAuxFilterOptimal_MaximumSearchSamples=250\n"
          "insertionLinDistance=0.5\ninsertionAngDistance_deg=30\n"
          "localizeLinDistance=0.2\nlocalizeAngDistance_deg=10\n"
          "verbosity_level=ERROR\npfOptimalProposal_mapSelection=0\n"
          "ICPGlobalAlign_MinQuality=0.70\nupdate_gridMapLikelihoodOptions=1\n"
          "occupancyGrid_count=1\npointsMap_count=0\nlikelihoodMapSelection=0\n"
          "[S_occupancyGrid_00_creationOpts]\nresolution="
       << take(options, "resolution_m", 0.06)
       << "\n[S_occupancyGrid_00_insertOpts]\nmaxDistanceInsertion=15\n"
          "maxOccupancyUpdateCertainty=0.55\nconsiderInvalidRangesAsFreeSpace=false\n"
          "[S_occupancyGrid_00_likelihoodOpts]\nlikelihoodMethod=4\nLF_decimation=5\n"
          "LF_stdHit=0.20\nLF_maxCorrsDistance=0.30\nLF_zHit=0.999\nLF_zRandom=0.001\n"
          "LF_maxRange=80\nLF_alternateAverageMethod=false\nenableLikelihoodCache=true\n";
  check_all_taken(options);
  mrpt::config::CConfigFileMemory config(text.str());
  mrpt::slam::CMetricMapBuilderRBPF::TConstructionOptions settings;
  settings.loadFromConfigFile(config, "S");
  settings.verbosity_level = mrpt::system::LVL_ERROR;
  mrpt::slam::CMetricMapBuilderRBPF builder(settings);
  builder.setVerbosityLevel(mrpt::system::LVL_ERROR);
  const mrpt::obs::CActionRobotMovement2D::TMotionModelOptions motion_model;
  for (std::size_t i = 0; i < scans.size(); ++i) {
    const CPose2D step =
        i ? scans[i].odometry - scans[i - 1].odometry : CPose2D(0.0, 0.0, 0.0);
    mrpt::obs::CActionRobotMovement2D moved;
    moved.computeFromOdometry(step, motion_model);
    moved.timestamp = scans[i].observation->timestamp;
    mrpt::obs::CActionCollection actions;
    actions.insert(moved);
    mrpt::obs::CSensoryFrame frame;
    frame.insert(scans[i].observation);
    builder.processActionObservation(actions, frame);
    const CPose2D believed(builder.getCurrentPoseEstimation()->getMeanVal());
    write_pose(out, scans[i].stamp, start + believed);
  }
}

int main(int argc, char** argv) {
  if (argc == 2 && std::string(argv[1]) == "version") {
    std::cout << MRPT_version_str << "\n";
    return 0;
  }
  if (argc < 6) fail("usage: mrpt icp|rbpf LOG START OUT SEED [KEY=VALUE ...]");
  const std::string mode = argv[1];
  const std::vector<Scan> scans = read_log(argv[2]);
  std::ifstream start_file(argv[3]);
  double x = 0.0, y = 0.0, heading = 0.0;
  if (!(start_file >> x >> y >> heading)) fail("the start is not known; set prior.start=tracking");
  std::ofstream out(argv[4]);
  mrpt::random::getRandomGenerator().randomize(
      static_cast<std::uint32_t>(std::strtoull(argv[5], nullptr, 10)));
  std::map<std::string, double> options;
  for (int i = 6; i < argc; ++i) {
    const std::string word = argv[i];
    const std::size_t equals = word.find('=');
    if (equals == std::string::npos) fail(word + ": give KEY=VALUE");
    options[word.substr(0, equals)] = std::atof(word.c_str() + equals + 1);
  }
  const CPose2D start(x, y, heading);
  if (mode == "icp") {
    run_icp(scans, start, out, options);
  } else if (mode == "rbpf") {
    run_rbpf(scans, start, out, options);
  } else {
    fail(mode + ": the methods are icp and rbpf");
  }
  out.close();
  if (!out) fail(std::string(argv[4]) + ": cannot write it");
  return 0;
}
