// The report's odometry by clouds with PCL's own registrations: the peer of steelnb's `report-icp`, `report-icp-3dof`
// and `report-gicp`. `report-peers.py` builds and runs it: pcl-peer METHOD SCANS POSES.
//
// SCANS: number of scans (uint32); for each scan its number of points (uint32), the drifting pose of the sensor in the
// world (16 doubles, row by row) and its points in the sensor frame, metres (3 floats each).
// POSES: for each scan the correction E after it (16 doubles, row by row; a corrected pose is E times the drifting
// one), then 1.0 where the scan was used, else 0.0.

#include <pcl/common/transforms.h>
#include <pcl/filters/voxel_grid.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/registration/gicp.h>
#include <pcl/registration/icp.h>

#include <chrono>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;
using Icp = pcl::IterativeClosestPoint<pcl::PointXYZ, pcl::PointXYZ>;
using Gicp = pcl::GeneralizedIterativeClosestPoint<pcl::PointXYZ, pcl::PointXYZ>;
using RowMajor = Eigen::Matrix<double, 4, 4, Eigen::RowMajor>;

constexpr float voxel_m = 0.1f;
constexpr double turn_max_rad = M_PI / 8;
constexpr double move_max_m = 1.0;

template <typename T>
T read(std::ifstream& file) {
  T value;
  if (!file.read(reinterpret_cast<char*>(&value), sizeof(T))) throw std::runtime_error("SCANS ends too early");
  return value;
}

// The points inside the report's box of the sensor frame.
Cloud::Ptr read_scan(std::ifstream& file, std::uint32_t points) {
  Cloud::Ptr scan(new Cloud);
  for (std::uint32_t i = 0; i < points; ++i) {
    const float x = read<float>(file), y = read<float>(file), z = read<float>(file);
    if (x >= -0.1f && x <= 4.0f && std::abs(y) <= 3.0f && std::abs(z) <= 3.0f) scan->emplace_back(x, y, z);
  }
  return scan;
}

void configure(Icp& icp, int iterations, double epsilon, double distance_m, double fitness_epsilon) {
  icp.setMaximumIterations(iterations);
  icp.setTransformationEpsilon(epsilon);
  icp.setMaxCorrespondenceDistance(distance_m);
  icp.setEuclideanFitnessEpsilon(fitness_epsilon);
}

int main(int argc, char** argv) try {
  if (argc != 4) throw std::runtime_error("expected METHOD SCANS POSES");
  const std::string method = argv[1];
  std::ifstream scans(argv[2], std::ios::binary);
  std::ofstream poses(argv[3], std::ios::binary);
  Cloud::Ptr map(new Cloud);
  Eigen::Matrix4f E = Eigen::Matrix4f::Identity();
  int used = 0;
  const auto count = read<std::uint32_t>(scans);
  const auto begin = std::chrono::steady_clock::now();
  for (std::uint32_t k = 0; k < count; ++k) {
    const auto points = read<std::uint32_t>(scans);
    RowMajor T_world_sensor;
    for (int i = 0; i < 16; ++i) T_world_sensor.data()[i] = read<double>(scans);
    Cloud::Ptr scan = read_scan(scans, points);
    const Eigen::Matrix4f T_start = E * T_world_sensor.cast<float>();
    pcl::transformPointCloud(*scan, *scan, T_start);
    bool accepted = false;
    if (map->empty()) {
      *map = *scan;
    } else if (!scan->empty()) {
      Icp icp;
      Gicp gicp;
      Icp& registration = method == "report-gicp" ? gicp : icp;
      if (method == "report-icp") {
        configure(icp, 150, 1e-3, 0.5, 1e-3);
        icp.setRANSACOutlierRejectionThreshold(0.05);
      } else if (method == "report-icp-3dof") {
        configure(icp, 200, 5e-4, 0.1, 1e-6);
        icp.setRANSACOutlierRejectionThreshold(0.1);
      } else if (method == "report-gicp") {
        configure(gicp, 150, 1e-5, 0.3, 1e-6);
      } else {
        throw std::runtime_error(method + ": expected report-icp, report-icp-3dof or report-gicp");
      }
      Cloud aligned;
      registration.setInputTarget(map);
      registration.setInputSource(scan);
      registration.align(aligned);
      Eigen::Matrix4f step = registration.getFinalTransformation();
      if (method == "report-icp-3dof") step.topLeftCorner<3, 3>().setIdentity();
      const double turn = std::acos((step.topLeftCorner<3, 3>().trace() - 1.0) * 0.5);  // NaN passes, as it did
      const double move = step.topRightCorner<3, 1>().norm();
      accepted = registration.hasConverged() && !(turn > turn_max_rad) && !(move > move_max_m);
      if (accepted) {
        ++used;
        E = E * step;
        *map += aligned;
        pcl::VoxelGrid<pcl::PointXYZ> grid;
        grid.setLeafSize(voxel_m, voxel_m, voxel_m);
        grid.setInputCloud(map);
        Cloud::Ptr thinned(new Cloud);
        grid.filter(*thinned);
        map = thinned;
      }
    }
    const RowMajor written = E.cast<double>();
    const double flag = accepted;
    poses.write(reinterpret_cast<const char*>(written.data()), 16 * sizeof(double));
    poses.write(reinterpret_cast<const char*>(&flag), sizeof(double));
  }
  const std::chrono::duration<double, std::milli> passed = std::chrono::steady_clock::now() - begin;
  std::cout << passed.count() / count << "\n";
  return 0;
} catch (const std::exception& fault) {
  std::cerr << "pcl-peer: " << fault.what() << "\n";
  return 2;
}
