// MRPT's scan matching, particle localization and Rao-Blackwellized SLAM over a CARMEN log, for
// estimator=offline.
//
//   make peers                                  # needs libmrpt-slam-dev (Debian)
//   build/peers/mrpt icp|rbpf LOG START OUT SEED [KEY=VALUE ...]
//   build/peers/mrpt mcl LOG START OUT SEED GRID [KEY=VALUE ...]
//   build/peers/mrpt version
//
// LOG has ROBOTLASER1 lines (laser pose and robot pose by odometry), START the first pose and its
// covariance, GRID is a map of ROS's map server, OUT gets TUM lines at the stamps of the scans.
// The settings are those of the examples that MRPT publishes for its own programs (share/mrpt/
// config_files), named below; KEY=VALUE changes one of them.

#include <mrpt/bayes/CParticleFilter.h>
#include <mrpt/config/CConfigFileMemory.h>
#include <mrpt/containers/yaml.h>
#include <mrpt/maps/CMultiMetricMap.h>
#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservation2DRangeScan.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/poses/CPosePDFGaussian.h>
#include <mrpt/random.h>
#include <mrpt/slam/CMetricMapBuilderICP.h>
#include <mrpt/slam/CMetricMapBuilderRBPF.h>
#include <mrpt/slam/CMonteCarloLocalization2D.h>
#include <mrpt/version.h>

#include <cstdlib>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

#include "carmen_log.hpp"

using mrpt::poses::CPose2D;
using mrpt::poses::CPosePDFGaussian;

// A scan as MRPT has it; its beams without a return are invalid.
mrpt::obs::CObservation2DRangeScan::Ptr observed(const Scan& scan) {
  auto seen = mrpt::obs::CObservation2DRangeScan::Create();
  const std::size_t n = scan.ranges_m.size();
  seen->aperture = static_cast<float>(scan.step_rad * (n - 1));
  seen->rightToLeft = true;
  seen->maxRange = static_cast<float>(scan.max_range_m);
  seen->stdError = static_cast<float>(scan.sigma_m);
  seen->resizeScan(n);
  for (std::size_t i = 0; i < n; ++i) {
    seen->setScanRange(i, static_cast<float>(scan.seen(i) ? scan.ranges_m[i] : 0.0));
    seen->setScanRangeValidity(i, scan.seen(i));
  }
  seen->sensorPose = mrpt::poses::CPose3D(scan.mount.x, scan.mount.y, 0.25,
                                          scan.mount.heading + scan.first_rad + seen->aperture / 2);
  seen->timestamp = mrpt::Clock::fromDouble(scan.stamp);
  seen->sensorLabel = "laser";
  return seen;
}

CPose2D mrpt_pose(const Pose& pose) { return {pose.x, pose.y, pose.heading}; }
Pose plain(const CPose2D& pose) { return {pose.x(), pose.y(), pose.phi()}; }

// icp-slam/icp-slam_demo_classic.ini
const char* const ICP = R"(
[ICP]
maxIterations=80
minAbsStep_trans=1e-6
minAbsStep_rot=1e-6
thresholdDist=0.3
thresholdAng_DEG=5
ALFA=0.8
smallestThresholdDist=0.05
onlyUniqueRobust=true
ICP_algorithm=icpClassic
corresponding_points_decimation=5
[S]
localizationLinDistance=0.2
localizationAngDistance=5
insertionLinDistance=1.2
insertionAngDistance=45
minICPgoodnessToAccept=0.40
matchAgainstTheGrid=0
occupancyGrid_count=0
pointsMap_count=1
likelihoodMapSelection=-1
[S_pointsMap_00_insertOpts]
minDistBetweenLaserPoints=0.05
fuseWithExisting=false
isPlanarMap=1
)";

// pf-localization/localization_demo.ini. Odometry's noise is the default of CActionRobotMovement2D, as
// in the other methods: with the example's [DummyOdometryParams] of 0.10 m and 2 degrees, once a scan,
// the error was twice as large and took 25 times as long (30 m drives, seed 0).
const char* const MCL = R"(
[PF]
PF_algorithm=0
resamplingMethod=0
adaptiveSampleSize=1
BETA=0.5
sampleSize=1
[KLD]
KLD_binSize_PHI_deg=10
KLD_binSize_XY=0.10
KLD_delta=0.01
KLD_epsilon=0.01
KLD_maxSampleSize=40000
KLD_minSampleSize=150
KLD_minSamplesPerBin=0
[Filter]
particles_count=40000
minStdXY=0.01
minStdPHI=0.2
[Likelihood]
likelihoodMethod=4
LF_decimation=10
LF_stdHit=0.40
LF_maxCorrsDistance=0.30
LF_zHit=0.95
LF_zRandom=0.05
LF_maxRange=80
LF_alternateAverageMethod=0
)";

// rbpf-slam/gridmapping_optimal_sampling.ini; the localize distances are the builder's defaults
const char* const RBPF = R"(
[S]
insertionLinDistance=1.0
insertionAngDistance_deg=40
localizeLinDistance=0.4
localizeAngDistance_deg=10
verbosity_level=ERROR
PF_algorithm=3
adaptiveSampleSize=0
resamplingMethod=0
sampleSize=25
BETA=0.50
powFactor=0.01
pfAuxFilterOptimal_MaximumSearchSamples=400
pfOptimalProposal_mapSelection=0
occupancyGrid_count=1
pointsMap_count=0
likelihoodMapSelection=-1
[S_occupancyGrid_00_creationOpts]
resolution=0.07
[S_occupancyGrid_00_insertOpts]
maxDistanceInsertion=35
maxOccupancyUpdateCertainty=0.60
considerInvalidRangesAsFreeSpace=1
minLaserScanNoiseStd=0.001
wideningBeamsWithDistance=0
[S_occupancyGrid_00_likelihoodOpts]
likelihoodMethod=4
LF_decimation=5
LF_stdHit=0.20
LF_maxCorrsDistance=0.30
LF_zHit=0.999
LF_zRandom=0.001
LF_maxRange=30
LF_alternateAverageMethod=0
enableLikelihoodCache=1
)";

using mrpt::config::CConfigFileMemory;

void change(CConfigFileMemory& settings, const std::string& word) {
  const std::size_t equals = word.find('=');
  if (equals == std::string::npos) fail(word + ": give KEY=VALUE");
  const std::string key = word.substr(0, equals);
  std::vector<std::string> sections;
  settings.getAllSections(sections);
  for (const auto& section : sections) {
    if (!settings.keyExists(section, key)) continue;
    settings.write(section, key, word.substr(equals + 1));
    return;
  }
  fail("unknown option " + key);
}

mrpt::obs::CActionCollection moved_between(
    const Scan& before, const Scan& now,
    const mrpt::obs::CActionRobotMovement2D::TMotionModelOptions& noise) {
  mrpt::obs::CActionRobotMovement2D moved;
  moved.computeFromOdometry(mrpt_pose(now.odometry) - mrpt_pose(before.odometry), noise);
  moved.timestamp = mrpt::Clock::fromDouble(now.stamp);
  mrpt::obs::CActionCollection actions;
  actions.insert(moved);
  return actions;
}

template <class Builder>
void build_map(Builder& builder, const std::vector<Scan>& scans, const CPose2D& start,
               std::ofstream& out) {
  builder.setVerbosityLevel(mrpt::system::LVL_ERROR);
  for (std::size_t i = 0; i < scans.size(); ++i) {
    auto actions = moved_between(scans[i ? i - 1 : 0], scans[i], {});
    mrpt::obs::CSensoryFrame frame;
    frame.insert(observed(scans[i]));
    builder.processActionObservation(actions, frame);
    const CPose2D believed(builder.getCurrentPoseEstimation()->getMeanVal());
    write_pose(out, scans[i].stamp, plain(start + believed));
    out << "\n";
  }
}

void run_icp(const std::vector<Scan>& scans, const CPose2D& start, std::ofstream& out,
             const CConfigFileMemory& settings) {
  mrpt::slam::CMetricMapBuilderICP builder;
  builder.ICP_options.loadFromConfigFile(settings, "S");
  builder.ICP_params.loadFromConfigFile(settings, "ICP");
  builder.initialize();
  build_map(builder, scans, start, out);
}

void run_rbpf(const std::vector<Scan>& scans, const CPose2D& start, std::ofstream& out,
              const CConfigFileMemory& settings) {
  mrpt::slam::CMetricMapBuilderRBPF::TConstructionOptions options;
  options.loadFromConfigFile(settings, "S");
  mrpt::slam::CMetricMapBuilderRBPF builder(options);
  build_map(builder, scans, start, out);
}

void run_mcl(const std::vector<Scan>& scans, const CPosePDFGaussian* start, std::ofstream& out,
             const CConfigFileMemory& settings, const std::string& grid_path) {
  const auto origin = mrpt::containers::yaml::FromFile(grid_path)["origin"].toStdVector<double>();
  if (origin.size() > 2 && origin[2] != 0.0) fail(grid_path + ": MRPT has no turned grids");
  const auto grid = mrpt::maps::COccupancyGridMap2D::Create();
  if (!grid->loadFromROSMapServerYAML(grid_path)) fail(grid_path + ": cannot read it");
  grid->likelihoodOptions.loadFromConfigFile(settings, "Likelihood");
  mrpt::bayes::CParticleFilter filter;
  filter.m_options.loadFromConfigFile(settings, "PF");
  const int count = settings.read_int("Filter", "particles_count", 0, true);
  mrpt::slam::CMonteCarloLocalization2D particles(count);
  particles.options.KLD_params.loadFromConfigFile(settings, "KLD");
  particles.options.metricMap = grid;
  if (start) {
    for (auto& particle : particles.m_particles) {
      CPose2D drawn;
      start->drawSingleSample(drawn);
      particle.d = drawn.asTPose();
    }
  } else {
    particles.resetUniformFreeSpace(grid.get(), 0.7, count);
  }
  mrpt::obs::CActionRobotMovement2D::TMotionModelOptions noise;
  noise.gaussianModel.minStdXY = settings.read_double("Filter", "minStdXY", 0.0, true);
  noise.gaussianModel.minStdPHI =
      mrpt::DEG2RAD(settings.read_double("Filter", "minStdPHI", 0.0, true));
  for (std::size_t i = 0; i < scans.size(); ++i) {
    const auto actions = moved_between(scans[i ? i - 1 : 0], scans[i], noise);
    mrpt::obs::CSensoryFrame frame;
    frame.insert(observed(scans[i]));
    if (i > 0 || !start) filter.executeOn(particles, &actions, &frame);
    const auto [covariance, mean] = particles.getCovarianceAndMean();
    write_pose(out, scans[i].stamp, plain(mean));
    write_covariance(out, covariance);
    out << "\n";
  }
}

int main(int argc, char** argv) {
  if (argc == 2 && std::string(argv[1]) == "version") {
    std::cout << MRPT_version_str << "\n";
    return 0;
  }
  const std::string mode = argc > 1 ? argv[1] : "";
  const bool icp = mode == "icp", mcl = mode == "mcl", rbpf = mode == "rbpf";
  if (!icp && !mcl && !rbpf) fail("the methods are icp, mcl and rbpf");
  const int first_option = mcl ? 7 : 6;
  if (argc < first_option) fail("usage: mrpt icp|mcl|rbpf LOG START OUT SEED [GRID] [KEY=VALUE ...]");
  const std::vector<Scan> scans = read_log(argv[2]);
  Pose mean;
  double covariance[3][3];
  const bool known = read_start(argv[3], mean, covariance);
  CPosePDFGaussian start(mrpt_pose(mean));
  for (int row = 0; known && row < 3; ++row)
    for (int column = 0; column < 3; ++column) start.cov(row, column) = covariance[row][column];
  if (!known && !mcl) fail("the start is not known; set prior.start=tracking");
  std::ofstream out(argv[4]);
  mrpt::random::getRandomGenerator().randomize(
      static_cast<std::uint32_t>(std::strtoull(argv[5], nullptr, 10)));
  CConfigFileMemory settings{std::string(icp ? ICP : mcl ? MCL : RBPF)};
  for (int i = first_option; i < argc; ++i) change(settings, argv[i]);
  if (icp) run_icp(scans, start.mean, out, settings);
  if (mcl) run_mcl(scans, known ? &start : nullptr, out, settings, argv[6]);
  if (rbpf) run_rbpf(scans, start.mean, out, settings);
  out.close();
  if (!out) fail(std::string(argv[4]) + ": cannot write it");
  return 0;
}
