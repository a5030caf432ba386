// What analytic Jacobians share: a posed body, a landmark before its cameras, the prior as rows.
#pragma once

#include <Eigen/Dense>
#include <cmath>
#include <vector>

#include "problem.h"

using V3 = Eigen::Vector3d;
using M3 = Eigen::Matrix3d;

inline M3 Cross(const V3& v) {
  M3 m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

// Joint positions, rotations, and world angular velocity per rate of each angle-axis vector; of
// each joint alone its rotation and left Jacobian.
struct PosedBody {
  std::vector<V3> position;
  std::vector<M3> rotation, twist, local, left;

  void Pose(const Problem& problem, const double* theta) {
    position.resize(problem.bones);
    for (auto* matrices : {&rotation, &twist, &local, &left}) matrices->resize(problem.bones);
    for (int bone = 0; bone < problem.bones; ++bone) {
      const V3 v(theta + 3 + 3 * bone);
      const double squared = v.squaredNorm(), angle = std::sqrt(squared);
      const bool small = squared < 1e-8;
      const double a = small ? 1 - squared / 6 : std::sin(angle) / angle;
      const double b = small ? 0.5 - squared / 24 : (1 - std::cos(angle)) / squared;
      const double c = small ? 1.0 / 6 - squared / 120 : (1 - a) / squared;
      const M3 skew = Cross(v), twice = v * v.transpose() - squared * M3::Identity();
      local[bone] = M3::Identity() + a * skew + b * twice;
      left[bone] = M3::Identity() + b * skew + c * twice;
      if (bone == 0) {
        rotation[0] = local[0];
        twist[0] = left[0];
        position[0] = V3(theta);
        continue;
      }
      const int parent = problem.parents[bone];
      rotation[bone].noalias() = rotation[parent] * local[bone];
      twist[bone].noalias() = rotation[parent] * left[bone];
      position[bone] = position[parent] + rotation[parent] * V3(problem.offsets + 3 * bone);
    }
  }

  V3 PointOf(int bone, const double* offset) const {
    return position[bone] + rotation[bone] * V3(offset);
  }
};

// Cameras that see landmark k.
inline std::vector<int> Seen(const Problem& problem, const Frame& frame, int k) {
  std::vector<int> seen;
  for (int camera = 0; camera < problem.cameras && problem.weights[0] > 0; ++camera) {
    const double* m = frame.keypoints + 3 * (camera * problem.landmarks + k);
    if (m[2] > 0 && std::isfinite(m[0] + m[1])) seen.push_back(camera);
  }
  return seen;
}

// One camera's reweighted residual of a landmark at x, and its derivative by x. Returns what their
// squares lack of the cost.
inline double Reproject(const Problem& problem, const Frame& frame, int k, int camera, const V3& x,
                        bool derivatives, Eigen::Vector2d* r, Eigen::Matrix<double, 2, 3>* d) {
  const double* c = problem.camera_rows + 24 * camera;
  const double* m = frame.keypoints + 3 * (camera * problem.landmarks + k);
  const double lambda = problem.weights[0] * m[2];
  const double z = c[6] * x[0] + c[7] * x[1] + c[8] * x[2] + c[11];
  const double inverse = 1 / z;
  const double a = (c[0] * x[0] + c[1] * x[1] + c[2] * x[2] + c[9]) * inverse;
  const double b = (c[3] * x[0] + c[4] * x[1] + c[5] * x[2] + c[10]) * inverse;
  const double r2 = a * a + b * b;
  if (!(z > kNear) || r2 > c[22]) {
    r->setZero();
    d->setZero();
    return std::log1p(lambda * kUnseenPixels * kUnseenPixels);
  }
  const double k1 = c[16], k2 = c[17], p1 = c[18], p2 = c[19], k3 = c[20];
  const double radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
  const double scale = std::sqrt(lambda) * c[21];
  (*r)[0] = c[12] * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + c[14] - m[0];
  (*r)[1] = c[13] * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + c[15] - m[1];
  *r *= scale;
  const double s = r->squaredNorm(), root = std::sqrt(1 / (1 + s));
  *r *= root;
  if (derivatives) {
    const double slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3));
    const double cross = a * b * slope + 2 * p1 * a + 2 * p2 * b;
    const double ua = c[12] * (radial + a * a * slope + 2 * p1 * b + 6 * p2 * a);
    const double ub = c[12] * cross, va = c[13] * cross;
    const double vb = c[13] * (radial + b * b * slope + 6 * p1 * b + 2 * p2 * a);
    const double by = scale * root * inverse, uc = -(ua * a + ub * b);
    const double vc = -(va * a + vb * b);
    for (int j = 0; j < 3; ++j) {
      (*d)(0, j) = by * (ua * c[j] + ub * c[3 + j] + uc * c[6 + j]);
      (*d)(1, j) = by * (va * c[j] + vb * c[3 + j] + vc * c[6 + j]);
    }
  }
  return std::log1p(s) - s / (1 + s);
}

// A landmark summed over cameras, three rows instead of two per camera: W = Σ JᵀJ = L Lᵀ, rows Lᵀ
// and residual L⁻¹ Σ Jᵀr. That is what fusecap's own kernel gains most from, given to Ceres. `rest`
// is what their squares lack of the cost: without derivatives there is no W, and it is all of it.
struct ReducedLandmark {
  M3 rows = M3::Zero();
  V3 r = V3::Zero();
  double rest = 0;

  ReducedLandmark(const Problem& problem, const Frame& frame, int k, const std::vector<int>& seen,
                  const V3& x, bool derivatives) {
    M3 information = M3::Zero(), lower = M3::Zero();
    V3 gradient = V3::Zero();
    for (int camera : seen) {
      Eigen::Vector2d one;
      Eigen::Matrix<double, 2, 3> d;
      rest += Reproject(problem, frame, k, camera, x, derivatives, &one, &d) + one.squaredNorm();
      if (!derivatives) continue;
      information.noalias() += d.transpose() * d;
      gradient.noalias() += d.transpose() * one;
    }
    if (!derivatives) return;
    const double tiny = 1e-13 * information.trace();
    for (int j = 0; j < 3; ++j) {
      double pivot = information(j, j);
      for (int i = 0; i < j; ++i) pivot -= lower(j, i) * lower(j, i);
      if (!(pivot > tiny)) continue;  // a direction that no camera sees
      lower(j, j) = std::sqrt(pivot);
      for (int i = j + 1; i < 3; ++i) {
        double sum = information(i, j);
        for (int n = 0; n < j; ++n) sum -= lower(i, n) * lower(j, n);
        lower(i, j) = sum / lower(j, j);
      }
    }
    for (int j = 0; j < 3; ++j) {
      double sum = gradient[j];
      for (int i = 0; i < j; ++i) sum -= lower(j, i) * r[i];
      r[j] = lower(j, j) > 0 ? sum / lower(j, j) : 0.0;
    }
    rest -= r.squaredNorm();
    rows = lower.transpose();
  }
};

// ‖x - M Mᵀ x‖ = ‖Nᵀ x‖ for N the orthogonal complement of M: rows Nᵀ, then diag(1/σ) Mᵀ, both
// prior terms as one matrix of full rank.
inline Eigen::MatrixXd PriorRows(const Problem& problem) {
  const Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>
      basis(problem.basis, problem.angles, problem.rank);
  const Eigen::HouseholderQR<Eigen::MatrixXd> qr(basis);
  const Eigen::MatrixXd q = qr.householderQ();
  Eigen::MatrixXd rows(problem.angles, problem.angles);
  rows.topRows(problem.angles - problem.rank) =
      q.rightCols(problem.angles - problem.rank).transpose();
  rows.bottomRows(problem.rank) =
      Eigen::Map<const Eigen::VectorXd>(problem.sigma, problem.rank).cwiseInverse().asDiagonal() *
      basis.transpose();
  return rows;
}
