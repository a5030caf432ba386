// Ceres at its best: one residual block for everything, so that the body is posed once per
// evaluation, one parameter block, analytic Jacobians.
//
// A loss function of Ceres acts on a whole block, but each keypoint needs one of its own. With
// s = λ‖r‖² and ρ = log(1 + s), rows √ρ' √λ r and √ρ' √λ J give the gradient and the matrix of
// iterative reweighting, as Ceres' own corrector does for Cauchy. Their sum of squares is ρ' s, less
// than ρ; one last row of zero derivative, √Σ(ρ - ρ' s), restores the cost exactly.
#pragma once

#include <ceres/ceres.h>

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <vector>

#include "problem.h"

class WholeBody : public ceres::CostFunction {
 public:
  // With `reduced`, the rows of a landmark are brought from two per camera to three before they
  // meet the 66 columns: W = Σ JᵀJ = L Lᵀ, rows Lᵀ and residual L⁻¹ Σ Jᵀr. That is what fusecap's
  // own kernel gains most from, given to Ceres.
  WholeBody(const Problem& problem, const Frame& frame, const Eigen::MatrixXd& complement,
            bool reduced)
      : problem_(problem), frame_(frame), complement_(complement), reduced_(reduced) {
    seen_.resize(problem.landmarks);
    int rows = 0;
    for (int k = 0; k < problem.landmarks && problem.weights[0] > 0; ++k) {
      for (int camera = 0; camera < problem.cameras; ++camera) {
        const double* m = frame.keypoints + 3 * (camera * problem.landmarks + k);
        if (m[2] > 0 && std::isfinite(m[0] + m[1])) seen_[k].push_back(camera);
      }
      rows += reduced ? 3 * !seen_[k].empty() : 2 * seen_[k].size();
    }
    for (int imu = 0; imu < problem.imus; ++imu) {
      if (problem.weights[1] > 0 && std::isfinite(frame.imu_rotation[9 * imu])) {
        oriented_.push_back(imu);
        rows += 3;
      }
      double known = 0;
      for (int i = 0; i < 3; ++i)
        known += frame.imu_accel[3 * imu + i] + frame.imu_history[3 * imu + i] +
                 frame.imu_history[3 * (problem.imus + imu) + i];
      if (problem.weights[2] > 0 && std::isfinite(known)) {
        accelerated_.push_back(imu);
        rows += 3;
      }
    }
    rows += problem.floor_bones + problem.angles + 1;
    set_num_residuals(rows);
    mutable_parameter_block_sizes()->push_back(problem.pose);
    position_.resize(problem.bones);
    rotation_.resize(problem.bones);
    twist_.resize(problem.bones);
  }

  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    const double* theta = parameters[0];
    double* jacobian = jacobians ? jacobians[0] : nullptr;
    if (jacobian) std::fill(jacobian, jacobian + num_residuals() * problem_.pose, 0.0);
    Pose(theta, jacobian != nullptr);
    out_ = residuals;
    row_ = jacobian;
    rest_ = 0.0;
    for (int k = 0; k < problem_.landmarks; ++k)
      if (!seen_[k].empty()) Landmark(k);
    for (int imu : oriented_) Orientation(imu);
    for (int imu : accelerated_) Acceleration(imu);
    for (int bone : problem_.floor_bone) Floor(bone);
    Priors(theta);
    *out_ = std::sqrt(std::max(rest_, 0.0));
    return true;
  }

 private:
  using V3 = Eigen::Vector3d;
  using M3 = Eigen::Matrix3d;
  using Rows = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor, 3, 3>;

  static M3 Cross(const V3& v) {
    M3 m;
    m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
    return m;
  }

  // Joint positions, rotations, and world angular velocity per rate of each angle-axis vector.
  void Pose(const double* theta, bool derivatives) const {
    for (int bone = 0; bone < problem_.bones; ++bone) {
      const V3 v(theta + 3 + 3 * bone);
      const double squared = v.squaredNorm(), angle = std::sqrt(squared);
      const bool small = squared < 1e-8;
      const double a = small ? 1 - squared / 6 : std::sin(angle) / angle;
      const double b = small ? 0.5 - squared / 24 : (1 - std::cos(angle)) / squared;
      const double c = small ? 1.0 / 6 - squared / 120 : (1 - a) / squared;
      const M3 skew = Cross(v), twice = v * v.transpose() - squared * M3::Identity();
      const M3 local = M3::Identity() + a * skew + b * twice;
      const M3 left = M3::Identity() + b * skew + c * twice;
      if (bone == 0) {
        rotation_[0] = local;
        twist_[0] = left;
        position_[0] = V3(theta);
        continue;
      }
      const int parent = problem_.parents[bone];
      rotation_[bone].noalias() = rotation_[parent] * local;
      if (derivatives) twist_[bone].noalias() = rotation_[parent] * left;
      position_[bone] = position_[parent] + rotation_[parent] * V3(problem_.offsets + 3 * bone);
    }
  }

  V3 PointOf(int bone, const double* offset) const {
    return position_[bone] + rotation_[bone] * V3(offset);
  }

  // Rows `d` (n, 3) are derivatives by a point at x on `bone`; chains them up to the root.
  template <typename Matrix>
  void Chain(int bone, const V3& x, const Matrix& d) const {
    const int n = d.rows(), width = problem_.pose;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < 3; ++j) row_[i * width + j] = d(i, j);
    for (int b : problem_.chains[bone]) {
      const V3 arm = x - position_[b];
      for (int j = 0; j < 3; ++j) {
        const V3 moved = twist_[b].col(j).cross(arm);
        for (int i = 0; i < n; ++i) row_[i * width + 3 + 3 * b + j] = d.row(i).dot(moved);
      }
    }
  }

  template <typename Vector>
  void Put(const Vector& r) const {
    for (int i = 0; i < r.size(); ++i) *out_++ = r[i];
    if (row_) row_ += r.size() * problem_.pose;
  }

  void Landmark(int k) const {
    const int bone = problem_.landmark_bone[k];
    const V3 x = PointOf(bone, problem_.landmark_offset + 3 * k);
    // Where the point moves per rate of each ancestor, shared by all cameras.
    const std::vector<int>& chain = problem_.chains[bone];
    M3 moved[32];
    if (row_ && !reduced_) {
      for (std::size_t a = 0; a < chain.size(); ++a) {
        const V3 arm = x - position_[chain[a]];
        for (int j = 0; j < 3; ++j) moved[a].col(j) = twist_[chain[a]].col(j).cross(arm);
      }
    }
    M3 information = M3::Zero();
    V3 gradient = V3::Zero();
    for (int camera : seen_[k]) {
      const double* c = problem_.camera_rows + 24 * camera;
      const double* m = frame_.keypoints + 3 * (camera * problem_.landmarks + k);
      const double lambda = problem_.weights[0] * m[2];
      Eigen::Vector2d r = Eigen::Vector2d::Zero();
      Eigen::Matrix<double, 2, 3> d = Eigen::Matrix<double, 2, 3>::Zero();
      const double z = c[6] * x[0] + c[7] * x[1] + c[8] * x[2] + c[11];
      const double inverse = 1 / z;
      const double a = (c[0] * x[0] + c[1] * x[1] + c[2] * x[2] + c[9]) * inverse;
      const double b = (c[3] * x[0] + c[4] * x[1] + c[5] * x[2] + c[10]) * inverse;
      const double r2 = a * a + b * b;
      if (z > kNear && !(r2 > c[22])) {
        const double k1 = c[16], k2 = c[17], p1 = c[18], p2 = c[19], k3 = c[20];
        const double radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
        r[0] = c[12] * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + c[14] - m[0];
        r[1] = c[13] * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + c[15] - m[1];
        const double scale = std::sqrt(lambda) * c[21];
        r *= scale;
        const double s = r.squaredNorm(), root = std::sqrt(1 / (1 + s));
        r *= root;
        rest_ += std::log1p(s) - s / (1 + s);
        if (row_) {
          const double slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3));
          const double cross = a * b * slope + 2 * p1 * a + 2 * p2 * b;
          const double ua = c[12] * (radial + a * a * slope + 2 * p1 * b + 6 * p2 * a);
          const double ub = c[12] * cross, va = c[13] * cross;
          const double vb = c[13] * (radial + b * b * slope + 6 * p1 * b + 2 * p2 * a);
          const double by = scale * root * inverse, uc = -(ua * a + ub * b);
          const double vc = -(va * a + vb * b);
          for (int j = 0; j < 3; ++j) {
            d(0, j) = by * (ua * c[j] + ub * c[3 + j] + uc * c[6 + j]);
            d(1, j) = by * (va * c[j] + vb * c[3 + j] + vc * c[6 + j]);
          }
        }
      } else {
        rest_ += std::log1p(lambda * kUnseenPixels * kUnseenPixels);
      }
      if (reduced_) {
        rest_ += r.squaredNorm();
        information.noalias() += d.transpose() * d;
        gradient.noalias() += d.transpose() * r;
        continue;
      }
      if (row_) {
        const int width = problem_.pose;
        for (int i = 0; i < 2; ++i)
          for (int j = 0; j < 3; ++j) row_[i * width + j] = d(i, j);
        for (std::size_t n = 0; n < chain.size(); ++n) {
          const Eigen::Matrix<double, 2, 3> block = d * moved[n];
          for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 3; ++j) row_[i * width + 3 + 3 * chain[n] + j] = block(i, j);
        }
      }
      Put(r);
    }
    if (!reduced_) return;
    // Without derivatives there is no W to factor, and all of the cost can go to the last row.
    V3 r = V3::Zero();
    if (row_) {
      M3 lower = M3::Zero();
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
      rest_ -= r.squaredNorm();
      Chain(bone, x, M3(lower.transpose()));
    }
    Put(r);
  }

  void Orientation(int imu) const {
    const int bone = problem_.imu_bone[imu];
    const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> measured(
        frame_.imu_rotation + 9 * imu);
    const M3 relative = rotation_[bone].transpose() * measured;
    Eigen::Quaterniond q(relative);
    if (q.w() < 0) q.coeffs() *= -1;
    const double scale = std::sqrt(problem_.weights[1]);
    if (row_) {
      const M3 turned =
          -0.5 * scale * (q.w() * M3::Identity() - Cross(q.vec())) * rotation_[bone].transpose();
      for (int b : problem_.chains[bone]) {
        const M3 block = turned * twist_[b];
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) row_[i * problem_.pose + 3 + 3 * b + j] = block(i, j);
      }
    }
    Put(V3(scale * q.vec()));
  }

  void Acceleration(int imu) const {
    const int bone = problem_.imu_bone[imu];
    const V3 x = PointOf(bone, problem_.imu_offset + 3 * imu);
    const double per_dt2 = 1 / (frame_.dt * frame_.dt), scale = std::sqrt(problem_.weights[2]);
    const V3 before(frame_.imu_history + 3 * imu);
    const V3 earlier(frame_.imu_history + 3 * (problem_.imus + imu));
    V3 r = (x - 2 * before + earlier) * per_dt2 - V3(frame_.imu_accel + 3 * imu);
    r *= scale;
    const double s = r.squaredNorm(), root = std::sqrt(1 / (1 + s));
    rest_ += std::log1p(s) - s / (1 + s);
    if (row_) Chain(bone, x, M3(root * scale * per_dt2 * M3::Identity()));
    Put(V3(root * r));
  }

  void Floor(int bone) const {
    const double depth = problem_.floor_radius - position_[bone].y();
    const double scale = depth > 0 ? std::sqrt(problem_.weights[5]) : 0.0;
    if (row_ && scale > 0) {
      Eigen::Matrix<double, 1, 3> d(0, -scale, 0);
      Chain(bone, position_[bone], d);
    }
    Put(Eigen::Matrix<double, 1, 1>(scale * depth));
  }

  // ‖x - M Mᵀ x‖ = ‖Nᵀ x‖ for N the orthogonal complement of M: fewer rows, the same norm.
  void Priors(const double* theta) const {
    const int angles = problem_.angles, rank = problem_.rank;
    const Eigen::VectorXd x = Eigen::Map<const Eigen::VectorXd>(theta + 6, angles) -
                              Eigen::Map<const Eigen::VectorXd>(problem_.mean, angles);
    const Eigen::VectorXd r = complement_ * x;
    for (const auto& [first, count, weight] :
         {std::make_tuple(0, angles - rank, problem_.weights[3]),
          std::make_tuple(angles - rank, rank, problem_.weights[4])}) {
      const double s = weight * r.segment(first, count).squaredNorm();
      const double root = std::sqrt(weight / (1 + s));
      rest_ += std::log1p(s) - s / (1 + s);
      if (row_)
        for (int i = 0; i < count; ++i)
          for (int j = 0; j < angles; ++j)
            row_[i * problem_.pose + 6 + j] = root * complement_(first + i, j);
      Put(Eigen::VectorXd(root * r.segment(first, count)));
    }
  }

  const Problem& problem_;
  const Frame frame_;
  const Eigen::MatrixXd& complement_;
  const bool reduced_;
  std::vector<std::vector<int>> seen_;
  std::vector<int> oriented_, accelerated_;
  // One thread evaluates at a time.
  mutable std::vector<V3> position_;
  mutable std::vector<M3> rotation_, twist_;
  mutable double *out_, *row_;
  mutable double rest_;
};

// Rows Nᵀ, then diag(1/σ) Mᵀ: both prior terms as one matrix of full rank.
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
