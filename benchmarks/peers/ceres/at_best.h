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

#include "posed.h"
#include "problem.h"

class WholeBody : public ceres::CostFunction {
 public:
  // With `reduced`, landmarks are summed over cameras first, see ReducedLandmark.
  WholeBody(const Problem& problem, const Frame& frame, const Eigen::MatrixXd& complement,
            bool reduced)
      : problem_(problem), frame_(frame), complement_(complement), reduced_(reduced) {
    seen_.resize(problem.landmarks);
    int rows = 0;
    for (int k = 0; k < problem.landmarks; ++k) {
      seen_[k] = Seen(problem, frame, k);
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
  }

  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    const double* theta = parameters[0];
    double* jacobian = jacobians ? jacobians[0] : nullptr;
    if (jacobian) std::fill(jacobian, jacobian + num_residuals() * problem_.pose, 0.0);
    body_.Pose(problem_, theta);
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
  // Rows `d` (n, 3) are derivatives by a point at x on `bone`; chains them up to the root.
  template <typename Matrix>
  void Chain(int bone, const V3& x, const Matrix& d) const {
    const int n = d.rows(), width = problem_.pose;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < 3; ++j) row_[i * width + j] = d(i, j);
    for (int b : problem_.chains[bone]) {
      const V3 arm = x - body_.position[b];
      for (int j = 0; j < 3; ++j) {
        const V3 moved = body_.twist[b].col(j).cross(arm);
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
    const V3 x = body_.PointOf(bone, problem_.landmark_offset + 3 * k);
    if (reduced_) {
      const ReducedLandmark all(problem_, frame_, k, seen_[k], x, row_ != nullptr);
      rest_ += all.rest;
      if (row_) Chain(bone, x, all.rows);
      return Put(all.r);
    }
    // Where the point moves per rate of each ancestor, shared by all cameras.
    const std::vector<int>& chain = problem_.chains[bone];
    M3 moved[32];
    if (row_) {
      for (std::size_t a = 0; a < chain.size(); ++a) {
        const V3 arm = x - body_.position[chain[a]];
        for (int j = 0; j < 3; ++j) moved[a].col(j) = body_.twist[chain[a]].col(j).cross(arm);
      }
    }
    for (int camera : seen_[k]) {
      Eigen::Vector2d r;
      Eigen::Matrix<double, 2, 3> d;
      rest_ += Reproject(problem_, frame_, k, camera, x, row_ != nullptr, &r, &d);
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
  }

  void Orientation(int imu) const {
    const int bone = problem_.imu_bone[imu];
    const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> measured(
        frame_.imu_rotation + 9 * imu);
    const M3 relative = body_.rotation[bone].transpose() * measured;
    Eigen::Quaterniond q(relative);
    if (q.w() < 0) q.coeffs() *= -1;
    const double scale = std::sqrt(problem_.weights[1]);
    if (row_) {
      const M3 turned = -0.5 * scale * (q.w() * M3::Identity() - Cross(q.vec())) *
                        body_.rotation[bone].transpose();
      for (int b : problem_.chains[bone]) {
        const M3 block = turned * body_.twist[b];
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) row_[i * problem_.pose + 3 + 3 * b + j] = block(i, j);
      }
    }
    Put(V3(scale * q.vec()));
  }

  void Acceleration(int imu) const {
    const int bone = problem_.imu_bone[imu];
    const V3 x = body_.PointOf(bone, problem_.imu_offset + 3 * imu);
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
    const double depth = problem_.floor_radius - body_.position[bone].y();
    const double scale = depth > 0 ? std::sqrt(problem_.weights[5]) : 0.0;
    if (row_ && scale > 0) {
      Eigen::Matrix<double, 1, 3> d(0, -scale, 0);
      Chain(bone, body_.position[bone], d);
    }
    Put(Eigen::Matrix<double, 1, 1>(scale * depth));
  }

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
  mutable PosedBody body_;
  mutable double *out_, *row_;
  mutable double rest_;
};
