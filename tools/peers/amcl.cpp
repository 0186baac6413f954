// nav2's Monte Carlo localization (AMCL) over a CARMEN log, for estimator=offline.
//
//   make peers NAV2=FOLDER                      # of the package nav2_amcl's sources
//   build/peers/amcl LOG START OUT SEED GRID [KEY=VALUE ...]
//   build/peers/amcl version
//
// LOG has ROBOTLASER1 lines (laser pose and robot pose by odometry), START the first pose and its
// covariance, GRID is a map of ROS's map server, OUT gets TUM lines at the stamps of the scans.
// The filter, its models of motion and of the laser are nav2's. This file stands for its node: it
// moves the filter when the robot has gone far enough, and takes the heaviest cluster for the pose.
// The settings are nav2's own (nav2_bringup/params/nav2_params.yaml); KEY=VALUE changes one of them.

#include <algorithm>
#include <map>

#include "carmen_log.hpp"
#include "nav2_amcl/map/map.hpp"
#include "nav2_amcl/pf/pf.hpp"
#include "nav2_amcl/sensors/laser/laser.hpp"
#include "src/motion_model/differential_motion_model.cpp"  // some versions have its class here alone

using Settings = std::map<std::string, double>;

const Settings DEFAULTS = {
    {"alpha1", 0.2},        {"alpha2", 0.2},
    {"alpha3", 0.2},        {"alpha4", 0.2},
    {"alpha5", 0.2},        {"laser_likelihood_max_dist", 2.0},
    {"max_beams", 60},      {"laser_max_range", 100.0},
    {"max_particles", 2000}, {"min_particles", 500},
    {"pf_err", 0.05},       {"pf_z", 0.99},
    {"resample_interval", 1}, {"recovery_alpha_fast", 0.0},
    {"sigma_hit", 0.2},     {"recovery_alpha_slow", 0.0},
    {"update_min_a", 0.2},  {"update_min_d", 0.25},
    {"z_hit", 0.5},         {"z_rand", 0.5},
};

Settings settings_of(int argc, char** argv) {
  Settings settings = DEFAULTS;
  for (int i = 6; i < argc; ++i) {
    const std::string word = argv[i];
    const std::size_t equals = word.find('=');
    if (equals == std::string::npos) fail(word + ": give KEY=VALUE");
    const auto found = settings.find(word.substr(0, equals));
    if (found == settings.end()) fail("unknown option " + word.substr(0, equals));
    char* end = nullptr;
    found->second = std::strtod(word.c_str() + equals + 1, &end);
    if (*end != '\0' || end == word.c_str() + equals + 1) fail(word + ": not a number");
  }
  return settings;
}

// A grid that Estima wrote: a YAML file of one key a line, and a PGM of bytes.
map_t* read_grid(const std::string& path) {
  std::ifstream file(path);
  if (!file) fail(path + ": cannot read it");
  std::map<std::string, std::string> keys;
  std::string line;
  while (std::getline(file, line))
    if (const std::size_t colon = line.find(": "); colon != std::string::npos)
      keys[line.substr(0, colon)] = line.substr(colon + 2);
  map_t* map = map_alloc();
  map->scale = std::atof(keys["resolution"].c_str());
  double x, y, turn;
  if (std::sscanf(keys["origin"].c_str(), "[%lf, %lf, %lf]", &x, &y, &turn) != 3)
    fail(path + ": no origin");
  if (turn != 0.0) fail(path + ": AMCL has no turned grids");
  const std::string image_path = path.substr(0, path.rfind('/') + 1) + keys["image"];
  std::ifstream image(image_path, std::ios::binary);
  std::string magic;
  int depth = 0;
  if (!(image >> magic >> map->size_x >> map->size_y >> depth) || magic != "P5" || depth != 255)
    fail(image_path + ": not a PGM of bytes");
  image.get();
  // AMCL's origin is the middle of the map, in world coordinates
  map->origin_x = x + (map->size_x / 2) * map->scale;
  map->origin_y = y + (map->size_y / 2) * map->scale;
  map->cells = static_cast<map_cell_t*>(
      std::malloc(sizeof(map_cell_t) * static_cast<std::size_t>(map->size_x) * map->size_y));
  for (int row = map->size_y - 1; row >= 0; --row)  // the first row is the top
    for (int column = 0; column < map->size_x; ++column) {
      const int shade = image.get();
      if (shade < 0) fail(image_path + ": cut short");
      map->cells[MAP_INDEX(map, column, row)].occ_state = shade < 64 ? 1 : shade > 250 ? -1 : 0;
    }
  return map;
}

std::vector<std::pair<int, int>> free_cells;

pf_vector_t anywhere(void* argument) {
  const map_t* map = static_cast<map_t*>(argument);
  const auto [i, j] = free_cells[static_cast<std::size_t>(drand48() * free_cells.size())];
  pf_vector_t pose;
  pose.v[0] = MAP_WXGX(map, i);
  pose.v[1] = MAP_WYGY(map, j);
  pose.v[2] = drand48() * 2.0 * M_PI - M_PI;
  return pose;
}

pf_vector_t vector_of(const Pose& pose) { return {{pose.x, pose.y, pose.heading}}; }

void sense(pf_t* filter, nav2_amcl::Laser& laser, const Scan& scan, double laser_max_range) {
  nav2_amcl::LaserData data;
  data.laser = &laser;
  data.range_count = static_cast<int>(scan.ranges_m.size());
  data.range_max = std::min(scan.max_range_m, laser_max_range);
  data.ranges = new double[scan.ranges_m.size()][2];  // which LaserData frees
  for (std::size_t i = 0; i < scan.ranges_m.size(); ++i) {
    data.ranges[i][0] = scan.seen(i) ? scan.ranges_m[i] : data.range_max;
    data.ranges[i][1] = scan.first_rad + scan.step_rad * static_cast<double>(i);
  }
  laser.sensorUpdate(filter, &data);
}

Pose heaviest(pf_t* filter) {
  const int clusters = filter->sets[filter->current_set].cluster_count;
  double most = -1.0;
  Pose best;
  for (int i = 0; i < clusters; ++i) {
    double weight;
    pf_vector_t mean;
    pf_matrix_t covariance;
    if (!pf_get_cluster_stats(filter, i, &weight, &mean, &covariance)) break;
    if (weight <= most) continue;
    most = weight;
    best = {mean.v[0], mean.v[1], mean.v[2]};
  }
  return best;
}

int main(int argc, char** argv) {
  if (argc == 2 && std::string(argv[1]) == "version") {
    std::cout << NAV2_VERSION << "\n";
    return 0;
  }
  if (argc < 6) fail("usage: amcl LOG START OUT SEED GRID [KEY=VALUE ...]");
  Settings of = settings_of(argc, argv);
  const std::vector<Scan> scans = read_log(argv[1]);
  map_t* map = read_grid(argv[5]);
  for (int j = 0; j < map->size_y; ++j)
    for (int i = 0; i < map->size_x; ++i)
      if (map->cells[MAP_INDEX(map, i, j)].occ_state == -1) free_cells.emplace_back(i, j);
  if (free_cells.empty()) fail(std::string(argv[5]) + ": no free cells");
  pf_t* filter = pf_alloc(static_cast<int>(of["min_particles"]), static_cast<int>(of["max_particles"]),
                          of["recovery_alpha_slow"], of["recovery_alpha_fast"], anywhere);
  filter->pop_err = of["pf_err"];
  filter->pop_z = of["pf_z"];
  const long seed = static_cast<long>(std::strtoull(argv[4], nullptr, 10));
  srand48(seed);
  Pose start;
  double covariance[3][3];
  if (read_start(argv[2], start, covariance)) {
    pf_matrix_t spread;
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 3; ++column) spread.m[row][column] = covariance[row][column];
    pf_init(filter, vector_of(start), spread);
    srand48(seed);  // its Gaussian has set a seed of its own
  } else {
    pf_init_model(filter, anywhere, map);
  }
  pf_init_converged(filter);
  nav2_amcl::DifferentialMotionModel differential;
  nav2_amcl::MotionModel& motion = differential;
  motion.initialize(of["alpha1"], of["alpha2"], of["alpha3"], of["alpha4"], of["alpha5"]);
  nav2_amcl::LikelihoodFieldModel laser(of["z_hit"], of["z_rand"], of["sigma_hit"],
                                        of["laser_likelihood_max_dist"],
                                        static_cast<size_t>(of["max_beams"]), map);
  pf_vector_t mount = vector_of(scans[0].mount);
  laser.SetLaserPose(mount);

  std::ofstream out(argv[3]);
  Pose used, correction;  // odometry at the last update; odom in map
  int updates = 0;
  for (const Scan& scan : scans) {
    const Pose& now = scan.odometry;
    const Pose moved = {now.x - used.x, now.y - used.y,
                        std::remainder(now.heading - used.heading, 2.0 * M_PI)};
    const bool first = &scan == &scans.front();
    if (first || std::abs(moved.x) > of["update_min_d"] || std::abs(moved.y) > of["update_min_d"] ||
        std::abs(moved.heading) > of["update_min_a"]) {
      if (!first) motion.odometryUpdate(filter, vector_of(now), vector_of(moved));
      used = now;
      sense(filter, laser, scan, of["laser_max_range"]);
      if (++updates % std::max(1, static_cast<int>(of["resample_interval"])) == 0)
        pf_update_resample(filter, map);
      correction = compose(heaviest(filter), between(now, Pose{}));
    }
    write_pose(out, scan.stamp, compose(correction, now));
    const pf_matrix_t& spread = filter->sets[filter->current_set].cov;
    write_covariance(out, [&](int row, int column) {  // a variance of nothing is rounded below it
      const double value = spread.m[row][column];
      return row == column ? std::max(value, 0.0) : value;
    });
    out << "\n";
  }
  out.close();
  if (!out) fail(std::string(argv[3]) + ": cannot write it");
  return 0;
}
