// Reads the file that benchmarks/peers/pose_problem.py writes; the layout is described there.
#pragma once

#include <cstddef>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

// A file of float64, taken from its start on.
class Numbers {
 protected:
  Numbers(const std::string& path, double magic) : path_(path) {
    std::ifstream file(path, std::ios::binary | std::ios::ate);
    if (!file) throw std::runtime_error("cannot read " + path);
    values_.resize(file.tellg() / sizeof(double));
    file.seekg(0);
    file.read(reinterpret_cast<char*>(values_.data()), values_.size() * sizeof(double));
    next_ = values_.data();
    if (*Take(1) != magic) throw std::runtime_error(path + " holds something else");
  }
  const double* Take(std::size_t count) {
    if (Left() < count) throw std::runtime_error(path_ + " is cut short");
    const double* taken = next_;
    next_ += count;
    return taken;
  }
  int Integer() { return static_cast<int>(*Take(1)); }
  std::vector<int> Integers(int count) {
    const double* taken = Take(count);
    return std::vector<int>(taken, taken + count);
  }
  std::size_t Left() const { return values_.data() + values_.size() - next_; }

 private:
  std::string path_;
  std::vector<double> values_;
  const double* next_;
};

struct Frame {
  const double* start;         // pose
  double dt;                   // seconds since the frame before
  const double* keypoints;     // camera, landmark, (x, y, confidence)
  const double* imu_rotation;  // imu, 3, 3 (row-major)
  const double* imu_accel;     // imu, 3
  const double* imu_history;   // (t-1, t-2), imu, 3
};

class Problem : Numbers {
 public:
  explicit Problem(const std::string& path) : Numbers(path, 20201.0) {
    bones = Integer();
    landmarks = Integer();
    cameras = Integer();
    imus = Integer();
    rank = Integer();
    floor_bones = Integer();
    frames = Integer();
    parents = Integers(bones);
    offsets = Take(3 * bones);
    landmark_bone = Integers(landmarks);
    landmark_offset = Take(3 * landmarks);
    camera_rows = Take(24 * cameras);
    imu_bone = Integers(imus);
    imu_offset = Take(3 * imus);
    angles = 3 * bones - 3;
    mean = Take(angles);
    basis = Take(angles * rank);
    sigma = Take(rank);
    floor_bone = Integers(floor_bones);
    floor_radius = *Take(1);
    weights = Take(6);
    function_tolerance = *Take(1);
    max_iterations = Integer();
    pose = 3 + 3 * bones;
    row_ = pose + 1 + 3 * cameras * landmarks + 18 * imus;
    first_ = Take(static_cast<std::size_t>(row_) * frames);
    if (Left()) throw std::runtime_error(path + " is longer than it says");
    for (int bone = 0; bone < bones; ++bone) {
      chains.push_back(bone ? chains[parents[bone]] : std::vector<int>());
      chains.back().push_back(bone);
    }
  }

  Frame frame(int index) const {
    const double* row = first_ + static_cast<std::size_t>(row_) * index;
    Frame frame;
    frame.start = row;
    frame.dt = row[pose];
    frame.keypoints = row + pose + 1;
    frame.imu_rotation = frame.keypoints + 3 * cameras * landmarks;
    frame.imu_accel = frame.imu_rotation + 9 * imus;
    frame.imu_history = frame.imu_accel + 3 * imus;
    return frame;
  }

  int bones, landmarks, cameras, imus, rank, floor_bones, frames, pose, angles, max_iterations;
  std::vector<int> parents, landmark_bone, imu_bone, floor_bone;
  std::vector<std::vector<int>> chains;  // per bone: from the root down to it
  const double *offsets, *landmark_offset, *camera_rows, *imu_offset, *mean, *basis, *sigma;
  const double* weights;  // position, orientation, acceleration, projection, deviation, floor
  double floor_radius, function_tolerance;

 private:
  const double* first_;
  std::size_t row_;
};

constexpr double kUnseenPixels = 1920.0;
constexpr double kNear = 0.05;
