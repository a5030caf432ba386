// The cost as one writes it with Ceres: a residual block per keypoint and camera, per IMU and per
// prior, automatic derivatives, a parameter block for the root's translation and for each bone's
// angle-axis vector. A block depends on the bones from the root down to its own.
#pragma once

#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <algorithm>
#include <cmath>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "problem.h"

// A point in the frame of the last bone of `chain`, carried to the world. `vectors` are the bones'
// angle-axis vectors in the order of the chain.
template <typename T>
void ToWorld(const Problem& problem, const std::vector<int>& chain, const T* root,
             T const* const* vectors, const double* point, T* x) {
  for (int i = 0; i < 3; ++i) x[i] = T(point[i]);
  for (int k = static_cast<int>(chain.size()) - 1; k >= 0; --k) {
    T turned[3];
    ceres::AngleAxisRotatePoint(vectors[k], x, turned);
    const double* offset = problem.offsets + 3 * chain[k];
    for (int i = 0; i < 3; ++i) x[i] = turned[i] + (k ? T(offset[i]) : root[i]);
  }
}

// Where a bone faces in the world, as a quaternion.
template <typename T>
void Turned(const Problem& problem, int bone, T const* const* vectors, T* q) {
  ceres::AngleAxisToQuaternion(vectors[0], q);
  for (std::size_t k = 1; k < problem.chains[bone].size(); ++k) {
    T local[4], product[4];
    ceres::AngleAxisToQuaternion(vectors[k], local);
    ceres::QuaternionProduct(q, local, product);
    std::copy(product, product + 4, q);
  }
}

struct Keypoint {  // eq. 5-7
  const Problem* problem;
  int landmark;
  const double* camera;
  const double* measured;

  template <typename T>
  bool operator()(T const* const* parameters, T* r) const {
    const std::vector<int>& chain = problem->chains[problem->landmark_bone[landmark]];
    T x[3];
    ToWorld(*problem, chain, parameters[0], parameters + 1,
            problem->landmark_offset + 3 * landmark, x);
    const double* c = camera;
    const T z = c[6] * x[0] + c[7] * x[1] + c[8] * x[2] + c[11];
    const double weight = std::sqrt(problem->weights[0] * measured[2]);
    if (z > kNear) {
      const T a = (c[0] * x[0] + c[1] * x[1] + c[2] * x[2] + c[9]) / z;
      const T b = (c[3] * x[0] + c[4] * x[1] + c[5] * x[2] + c[10]) / z;
      const T r2 = a * a + b * b;
      if (!(r2 > c[22])) {
        const T radial = 1.0 + r2 * (c[16] + r2 * (c[17] + r2 * c[20]));
        const T u = a * radial + 2.0 * c[18] * a * b + c[19] * (r2 + 2.0 * a * a);
        const T v = b * radial + c[18] * (r2 + 2.0 * b * b) + 2.0 * c[19] * a * b;
        r[0] = weight * c[21] * (c[12] * u + c[14] - measured[0]);
        r[1] = weight * c[21] * (c[13] * v + c[15] - measured[1]);
        return true;
      }
    }
    r[0] = T(weight * kUnseenPixels);
    r[1] = T(0.0);
    return true;
  }
};

struct Orientation {  // eq. 8-10
  const Problem* problem;
  int bone;
  const double* measured;

  template <typename T>
  bool operator()(T const* const* parameters, T* r) const {
    // q = (q_0 q_1 ... q_bone)⁻¹ q_measured
    T turned[4];
    Turned(*problem, bone, parameters, turned);
    double target[4];
    ceres::RotationMatrixToQuaternion(ceres::RowMajorAdapter3x3(measured), target);
    const T wanted[4] = {T(target[0]), T(target[1]), T(target[2]), T(target[3])};
    const T inverse[4] = {turned[0], -turned[1], -turned[2], -turned[3]};
    T q[4];
    ceres::QuaternionProduct(inverse, wanted, q);
    const double sign = q[0] < T(0.0) ? -1.0 : 1.0;
    for (int i = 0; i < 3; ++i) r[i] = sign * std::sqrt(problem->weights[1]) * q[1 + i];
    return true;
  }
};

struct Acceleration {  // eq. 11-13
  const Problem* problem;
  Frame frame;
  int imu;

  template <typename T>
  bool operator()(T const* const* parameters, T* r) const {
    T x[3];
    ToWorld(*problem, problem->chains[problem->imu_bone[imu]], parameters[0], parameters + 1,
            problem->imu_offset + 3 * imu, x);
    const double* before = frame.imu_history + 3 * imu;
    const double* earlier = before + 3 * problem->imus;
    for (int i = 0; i < 3; ++i)
      r[i] = std::sqrt(problem->weights[2]) *
             ((x[i] - 2.0 * before[i] + earlier[i]) / (frame.dt * frame.dt) -
              frame.imu_accel[3 * imu + i]);
    return true;
  }
};

struct Prior {  // eq. 14 or, with `deviation`, eq. 15
  const Problem* problem;
  bool deviation;

  template <typename T>
  bool operator()(T const* const* parameters, T* r) const {
    const int angles = problem->angles, rank = problem->rank;
    std::vector<T> x(angles), component(rank, T(0.0));
    for (int i = 0; i < angles; ++i) x[i] = parameters[i / 3][i % 3] - problem->mean[i];
    for (int i = 0; i < angles; ++i)
      for (int j = 0; j < rank; ++j) component[j] += problem->basis[i * rank + j] * x[i];
    if (deviation) {
      for (int j = 0; j < rank; ++j)
        r[j] = std::sqrt(problem->weights[4]) * component[j] / problem->sigma[j];
      return true;
    }
    for (int i = 0; i < angles; ++i) {
      r[i] = x[i];
      for (int j = 0; j < rank; ++j) r[i] -= problem->basis[i * rank + j] * component[j];
      r[i] *= std::sqrt(problem->weights[3]);
    }
    return true;
  }
};

struct Floor {  // eq. 16
  const Problem* problem;
  int bone;

  template <typename T>
  bool operator()(T const* const* parameters, T* r) const {
    // The joint of a bone is a point of its parent.
    T x[3];
    ToWorld(*problem, problem->chains[problem->parents[bone]], parameters[0], parameters + 1,
            problem->offsets + 3 * bone, x);
    const T depth = problem->floor_radius - x[1];
    r[0] = depth > T(0.0) ? std::sqrt(problem->weights[5]) * depth : T(0.0);
    return true;
  }
};

// AutoDiffCostFunction hands over parameter blocks one by one; the terms want them as an array.
template <typename Term>
struct Unpacked {
  Term term;

  template <typename... Pointers>
  bool operator()(Pointers... pointers) const {
    using Last = std::tuple_element_t<sizeof...(Pointers) - 1, std::tuple<Pointers...>>;
    using T = std::remove_pointer_t<Last>;
    const T* parameters[] = {pointers...};
    return term(parameters, const_cast<T*>(parameters[sizeof...(Pointers) - 1]));
  }
};

template <int kResiduals, typename Term, std::size_t... Blocks>
ceres::CostFunction* Templated(const Term& term, int residuals, std::index_sequence<Blocks...>) {
  using Function = ceres::AutoDiffCostFunction<Unpacked<Term>, kResiduals, (Blocks * 0 + 3)...>;
  if constexpr (kResiduals == ceres::DYNAMIC)
    return new Function(new Unpacked<Term>{term}, residuals);
  else
    return new Function(new Unpacked<Term>{term});
}

template <typename Term>
ceres::CostFunction* Dynamic(const Term& term, int residuals, int blocks) {
  auto* function = new ceres::DynamicAutoDiffCostFunction<Term>(new Term(term));
  for (int i = 0; i < blocks; ++i) function->AddParameterBlock(3);
  function->SetNumResiduals(residuals);
  return function;
}

// `kFrom` to `kTo` are the numbers of blocks that the term can have; `residuals` is kResiduals where
// that is not ceres::DYNAMIC.
template <int kResiduals, int kFrom, int kTo, typename Term>
ceres::CostFunction* AutoDiff(const Term& term, int residuals, int blocks, bool dynamic) {
  if (dynamic) return Dynamic(term, residuals, blocks);
  if (blocks == kFrom)
    return Templated<kResiduals>(term, residuals, std::make_index_sequence<kFrom>());
  if constexpr (kFrom < kTo)
    return AutoDiff<kResiduals, kFrom + 1, kTo>(term, residuals, blocks, dynamic);
  throw std::runtime_error("no cost function is compiled for a chain of this length");
}

// The parameter blocks that a point on `bone` depends on; without the root's place, its rotation.
inline std::vector<double*> ChainBlocks(const Problem& problem, int bone, bool with_root,
                                        double* theta) {
  std::vector<double*> found;
  if (with_root) found.push_back(theta);
  for (int b : problem.chains[bone]) found.push_back(theta + 3 + 3 * b);
  return found;
}

inline void BuildAsPaper(const Problem& problem, const Frame& frame, double* theta, bool dynamic,
                         ceres::Problem* built) {
  const auto blocks = [&](int bone, bool with_root) {
    return ChainBlocks(problem, bone, with_root, theta);
  };
  const auto robust = [] { return new ceres::CauchyLoss(1.0); };
  const double* weights = problem.weights;
  for (int camera = 0; camera < problem.cameras && weights[0] > 0; ++camera) {
    for (int k = 0; k < problem.landmarks; ++k) {
      const double* measured = frame.keypoints + 3 * (camera * problem.landmarks + k);
      if (!(measured[2] > 0) || !std::isfinite(measured[0] + measured[1])) continue;
      const auto chain = blocks(problem.landmark_bone[k], true);
      const Keypoint term{&problem, k, problem.camera_rows + 24 * camera, measured};
      built->AddResidualBlock(AutoDiff<2, 2, 9>(term, 2, chain.size(), dynamic), robust(), chain);
    }
  }
  for (int imu = 0; imu < problem.imus; ++imu) {
    const int bone = problem.imu_bone[imu];
    const double* measured = frame.imu_rotation + 9 * imu;
    if (weights[1] > 0 && std::isfinite(measured[0])) {
      const auto chain = blocks(bone, false);
      const Orientation term{&problem, bone, measured};
      built->AddResidualBlock(AutoDiff<3, 1, 8>(term, 3, chain.size(), dynamic), nullptr, chain);
    }
    double known = 0;
    for (int i = 0; i < 3; ++i)
      known += frame.imu_accel[3 * imu + i] + frame.imu_history[3 * imu + i] +
               frame.imu_history[3 * (problem.imus + imu) + i];
    if (weights[2] > 0 && std::isfinite(known)) {
      const auto chain = blocks(bone, true);
      const Acceleration term{&problem, frame, imu};
      built->AddResidualBlock(AutoDiff<3, 2, 9>(term, 3, chain.size(), dynamic), robust(), chain);
    }
  }
  std::vector<double*> angles;
  for (int bone = 1; bone < problem.bones; ++bone) angles.push_back(theta + 3 + 3 * bone);
  for (const bool deviation : {false, true}) {
    if (!(weights[deviation ? 4 : 3] > 0)) continue;
    const int residuals = deviation ? problem.rank : problem.angles;
    const Prior term{&problem, deviation};
    auto* function =
        AutoDiff<ceres::DYNAMIC, 20, 20>(term, residuals, angles.size(), dynamic);
    built->AddResidualBlock(function, robust(), angles);
  }
  for (int bone : problem.floor_bone) {
    if (!(weights[5] > 0)) continue;
    const auto chain = blocks(problem.parents[bone], true);
    const Floor term{&problem, bone};
    built->AddResidualBlock(AutoDiff<1, 2, 9>(term, 1, chain.size(), dynamic), nullptr, chain);
  }
}
