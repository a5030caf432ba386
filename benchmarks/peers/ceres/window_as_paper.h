// A window as one writes it with Ceres: every instant as in as_paper.h, and between instants a
// residual block per joint and sensor, automatic derivatives.
#pragma once

#include "as_paper.h"
#include "window.h"

// The turn from quaternion a to b, as a quaternion.
template <typename A, typename B, typename T>
void TurnBetween(const A* a, const B* b, T* q) {
  const T inverse[4] = {T(a[0]), -T(a[1]), -T(a[2]), -T(a[3])};
  const T to[4] = {T(b[0]), T(b[1]), T(b[2]), T(b[3])};
  ceres::QuaternionProduct(inverse, to, q);
}

struct Steadiness {
  double weight;
  bool rotates;  // a joint's rotation, or the root's place
  double c[3];

  template <typename T>
  bool operator()(T const* const* x, T* r) const {
    T before[3], after[3];
    if (rotates) {
      T q[3][4], turn[4];
      for (int k = 0; k < 3; ++k) ceres::AngleAxisToQuaternion(x[k], q[k]);
      TurnBetween(q[0], q[1], turn);
      ceres::QuaternionToAngleAxis(turn, before);
      TurnBetween(q[1], q[2], turn);
      ceres::QuaternionToAngleAxis(turn, after);
    } else {
      for (int i = 0; i < 3; ++i) before[i] = x[1][i] - x[0][i];
      for (int i = 0; i < 3; ++i) after[i] = x[2][i] - x[1][i];
    }
    for (int i = 0; i < 3; ++i) r[i] = std::sqrt(weight) * (c[2] * after[i] - c[0] * before[i]);
    return true;
  }
};

struct Increment {
  const Problem* problem;
  int bone;
  const double* measured[2];
  double weight;

  template <typename T>
  bool operator()(T const* const* parameters, T* r) const {
    T q0[4], q1[4], solved[4], q[4];
    Turned(*problem, bone, parameters, q0);
    Turned(*problem, bone, parameters + problem->chains[bone].size(), q1);
    TurnBetween(q0, q1, solved);
    double m0[4], m1[4], sensed[4];
    ceres::RotationMatrixToQuaternion(ceres::RowMajorAdapter3x3(measured[0]), m0);
    ceres::RotationMatrixToQuaternion(ceres::RowMajorAdapter3x3(measured[1]), m1);
    TurnBetween(m0, m1, sensed);
    TurnBetween(solved, sensed, q);
    const double sign = q[0] < T(0.0) ? -2.0 : 2.0;
    for (int i = 0; i < 3; ++i) r[i] = sign * std::sqrt(weight) * q[1 + i];
    return true;
  }
};

struct SpecificForce {
  const Problem* problem;
  int imu;
  const double* felt;
  double weight, c[3];

  template <typename T>
  bool operator()(T const* const* parameters, T* r) const {
    const std::vector<int>& chain = problem->chains[problem->imu_bone[imu]];
    const std::size_t blocks = 1 + chain.size();
    T u[3] = {T(0.0), T(kGravity), T(0.0)};
    for (int k = 0; k < 3; ++k) {
      T const* const* p = parameters + k * blocks;
      T x[3];
      ToWorld(*problem, chain, p[0], p + 1, problem->imu_offset + 3 * imu, x);
      for (int i = 0; i < 3; ++i) u[i] += c[k] * x[i];
    }
    T q[4], in_bone[3];
    Turned(*problem, chain.back(), parameters + blocks + 1, q);
    const T inverse[4] = {q[0], -q[1], -q[2], -q[3]};
    ceres::UnitQuaternionRotatePoint(inverse, u, in_bone);
    for (int i = 0; i < 3; ++i) r[i] = std::sqrt(weight) * (in_bone[i] - felt[i]);
    return true;
  }
};

inline void BuildWindowAsPaper(const Problem& problem, const Windows& windows, int first,
                               double* theta, ceres::Problem* built) {
  const auto add = [&](const auto& term, const std::vector<double*>& blocks) {
    auto* loss = new ceres::CauchyLoss(std::sqrt(kLossScale));
    built->AddResidualBlock(Dynamic(term, 3, blocks.size()), loss, blocks);
  };
  // The blocks of a chain at several instants.
  const auto chains = [&](int bone, bool with_root, int from, int to) {
    std::vector<double*> found;
    for (int t = from; t < to; ++t)
      for (double* block : ChainBlocks(problem, bone, with_root, theta + t * problem.pose))
        found.push_back(block);
    return found;
  };
  for (int t = 0; t < windows.length; ++t) {
    const Frame frame = problem.frame(first + t);
    BuildAsPaper(problem, frame, theta + t * problem.pose, true, built);
    for (int imu = 0; imu < problem.imus && t > 0; ++imu) {
      const int bone = problem.imu_bone[imu];
      const double* before = problem.frame(first + t - 1).imu_rotation + 9 * imu;
      const double* after = frame.imu_rotation + 9 * imu;
      if (!std::isfinite(before[0] + after[0])) continue;
      add(Increment{&problem, bone, {before, after}, windows.increment},
          chains(bone, false, t - 1, t + 1));
    }
  }
  for (int t = 1; t + 1 < windows.length; ++t) {
    double c[3];
    windows.Difference(first + t, c);
    for (int block = 0; block <= problem.bones; ++block) {
      double* x = theta + t * problem.pose + 3 * block;
      add(Steadiness{windows.motion * windows.steadiness[block], block > 0, {c[0], c[1], c[2]}},
          {x - problem.pose, x, x + problem.pose});
    }
    for (int imu = 0; imu < problem.imus; ++imu) {
      const double* felt = windows.force(first + t, imu);
      if (!std::isfinite(felt[0])) continue;
      add(SpecificForce{&problem, imu, felt, windows.specific_force, {c[0], c[1], c[2]}},
          chains(problem.imu_bone[imu], true, t - 1, t + 2));
    }
  }
}
