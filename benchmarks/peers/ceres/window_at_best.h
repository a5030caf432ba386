// A window for Ceres at its best: analytic Jacobians, bodies posed once per evaluation for all
// terms, landmarks summed over cameras, few parameter blocks.
//
// Ceres multiplies Jacobians block by block. A parameter block per joint makes a thousand small
// products of every term that reaches over three instants, one per pose fills them with zeros; a
// block per limb, the bones between two branchings of the body, is in between.
#pragma once

#include <ceres/ceres.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "clock.h"
#include "posed.h"
#include "window.h"

// A pose's columns in parameter blocks: "joints", "limbs" or "poses". The root's place goes with
// the first bone.
struct Partition {
  std::vector<int> first, size;  // per block
  std::vector<int> block;        // per bone

  Partition(const Problem& problem, const std::string& kind) {
    std::vector<int> children(problem.bones, 0);
    for (int bone = 1; bone < problem.bones; ++bone) ++children[problem.parents[bone]];
    for (int bone = 0; bone < problem.bones; ++bone) {
      const int parent = problem.parents[bone];
      const bool continues =
          bone > 0 && (kind == "poses" ||
                       (kind == "limbs" && parent == bone - 1 && children[parent] == 1));
      if (!continues) {
        first.push_back(bone ? 3 + 3 * bone : 0);
        size.push_back(bone ? 0 : 3);
      }
      size.back() += 3;
      block.push_back(static_cast<int>(size.size()) - 1);
    }
  }
};

// The poses of all instants, brought up to date before every evaluation; and when the last
// linearisation began.
class Instants : public ceres::EvaluationCallback {
 public:
  Instants(const Problem& problem, const double* theta, int count)
      : problem_(problem), theta_(theta), bodies_(count) {}

  void PrepareForEvaluation(bool jacobians, bool new_point) override {
    if (jacobians) linearised_at = ProcessorSeconds();
    for (std::size_t t = 0; t < bodies_.size() && new_point; ++t)
      bodies_[t].Pose(problem_, theta_ + t * problem_.pose);
  }
  const PosedBody& operator[](int t) const { return bodies_[t]; }

  double linearised_at = 0;

 private:
  const Problem& problem_;
  const double* theta_;
  std::vector<PosedBody> bodies_;
};

struct WindowParts {
  const Problem& problem;
  const Windows& windows;
  const Partition& partition;
  const Instants& instants;
  const Eigen::MatrixXd& prior_rows;
};

// Of one bone or, with a negative one, all bones, at `span` instants from t on.
class WindowTerm : public ceres::CostFunction {
 public:
  WindowTerm(const WindowParts& parts, int t, int span, int bone, int residuals)
      : parts_(parts), problem_(parts.problem), t_(t), span_(span), bone_(bone) {
    set_num_residuals(residuals);
    slot_.assign(parts.partition.size.size(), -1);
    for (int b = 0; b < problem_.bones; ++b) {
      const int block = parts.partition.block[b];
      const auto& chain = problem_.chains[std::max(bone, 0)];
      if (bone >= 0 && !std::count(chain.begin(), chain.end(), b)) continue;
      if (slot_[block] >= 0) continue;
      slot_[block] = static_cast<int>(blocks_.size());
      blocks_.push_back(block);
    }
    for (int k = 0; k < span; ++k)
      for (int block : blocks_)
        mutable_parameter_block_sizes()->push_back(parts.partition.size[block]);
  }

  void AddTo(ceres::Problem* built, double* theta, ceres::LossFunction* loss) {
    std::vector<double*> found;
    for (int k = 0; k < span_; ++k)
      for (int block : blocks_)
        found.push_back(theta + (t_ + k) * problem_.pose + parts_.partition.first[block]);
    built->AddResidualBlock(this, loss, found);
  }

  bool Evaluate(double const* const*, double* residuals, double** jacobians) const override {
    for (std::size_t i = 0; jacobians && i < parameter_block_sizes().size(); ++i)
      std::fill(jacobians[i], jacobians[i] + num_residuals() * parameter_block_sizes()[i], 0.0);
    Compute(residuals, jacobians);
    return true;
  }

 protected:
  virtual void Compute(double* r, double** jacobians) const = 0;

  const PosedBody& Body(int k) const { return parts_.instants[t_ + k]; }

  // Adds the derivatives of the first rows by three columns of the pose at instant k.
  template <typename Matrix>
  void Add(double** jacobians, int k, int block, int column, const Matrix& d) const {
    double* out = jacobians[k * blocks_.size() + slot_[block]];
    const int width = parts_.partition.size[block];
    column -= parts_.partition.first[block];
    for (int i = 0; i < d.rows(); ++i)
      for (int j = 0; j < 3; ++j) out[i * width + column + j] += d(i, j);
  }

  // Rows `d` are derivatives by where this bone is turned in the world.
  template <typename Matrix>
  void AddTurn(double** jacobians, int k, const Matrix& d) const {
    for (int b : problem_.chains[bone_])
      Add(jacobians, k, parts_.partition.block[b], 3 + 3 * b, Matrix(d * Body(k).twist[b]));
  }

  // Rows `d` are derivatives by a point at x on this bone.
  template <typename Matrix>
  void AddPoint(double** jacobians, int k, const V3& x, const Matrix& d) const {
    Add(jacobians, k, 0, 0, d);
    for (int b : problem_.chains[bone_]) {
      const Matrix turned = d * Cross(Body(k).position[b] - x);
      Add(jacobians, k, parts_.partition.block[b], 3 + 3 * b, Matrix(turned * Body(k).twist[b]));
    }
  }

  const WindowParts& parts_;
  const Problem& problem_;
  const int t_, span_, bone_;

 private:
  std::vector<int> blocks_;  // of one instant
  std::vector<int> slot_;    // per block of the pose
};

class WindowLandmark : public WindowTerm {
 public:
  WindowLandmark(const WindowParts& parts, int t, const Frame& frame, int k)
      : WindowTerm(parts, t, 1, parts.problem.landmark_bone[k], 4), frame_(frame), k_(k) {
    seen_ = Seen(problem_, frame, k);
  }
  bool Empty() const { return seen_.empty(); }

 protected:
  void Compute(double* r, double** jacobians) const override {
    const V3 x = Body(0).PointOf(bone_, problem_.landmark_offset + 3 * k_);
    const ReducedLandmark all(problem_, frame_, k_, seen_, x, jacobians != nullptr);
    std::copy(all.r.data(), all.r.data() + 3, r);
    r[3] = std::sqrt(std::max(all.rest, 0.0));
    if (jacobians) AddPoint(jacobians, 0, x, all.rows);
  }

 private:
  const Frame frame_;
  const int k_;
  std::vector<int> seen_;
};

// scale v of the quaternion (w, v) of (turned)ᵀ measured; returns its derivative by a turn of the
// bone.
inline M3 TurnError(const M3& turned, const M3& measured, double scale, const M3& bone, double* r) {
  Eigen::Quaterniond q(M3(turned.transpose() * measured));
  if (q.w() < 0) q.coeffs() *= -1;
  Eigen::Map<V3>(r, 3) = scale * q.vec();
  return -0.5 * scale * (q.w() * M3::Identity() - Cross(q.vec())) * bone.transpose();
}

inline M3 MeasuredRotation(const Frame& frame, int imu) {
  return Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(frame.imu_rotation +
                                                                       9 * imu);
}

class WindowOrientation : public WindowTerm {
 public:
  WindowOrientation(const WindowParts& parts, int t, const Frame& frame, int imu)
      : WindowTerm(parts, t, 1, parts.problem.imu_bone[imu], 3),
        measured_(MeasuredRotation(frame, imu)) {}

 protected:
  void Compute(double* r, double** jacobians) const override {
    const M3& bone = Body(0).rotation[bone_];
    const M3 d = TurnError(bone, measured_, std::sqrt(problem_.weights[1]), bone, r);
    if (jacobians) AddTurn(jacobians, 0, d);
  }

 private:
  const M3 measured_;
};

class WindowFloor : public WindowTerm {
 public:
  WindowFloor(const WindowParts& parts, int t, int bone) : WindowTerm(parts, t, 1, bone, 1) {}

 protected:
  void Compute(double* r, double** jacobians) const override {
    const V3& x = Body(0).position[bone_];
    const double depth = problem_.floor_radius - x.y();
    const double scale = depth > 0 ? std::sqrt(problem_.weights[5]) : 0.0;
    r[0] = scale * depth;
    if (jacobians) AddPoint(jacobians, 0, x, Eigen::Matrix<double, 1, 3>(0, -scale, 0));
  }
};

class WindowPrior : public WindowTerm {
 public:
  WindowPrior(const WindowParts& parts, int t, const double* theta, int first, int count,
              double weight)
      : WindowTerm(parts, t, 1, -1, count),
        theta_(theta + t * parts.problem.pose),
        rows_(std::sqrt(weight) * parts.prior_rows.middleRows(first, count)) {}

 protected:
  void Compute(double* r, double** jacobians) const override {
    const int angles = problem_.angles;
    const Eigen::Map<const Eigen::VectorXd> x(theta_ + 6, angles), mean(problem_.mean, angles);
    Eigen::Map<Eigen::VectorXd>(r, rows_.rows()).noalias() = rows_ * (x - mean);
    for (int bone = 1; bone < problem_.bones && jacobians; ++bone)
      Add(jacobians, 0, parts_.partition.block[bone], 3 + 3 * bone,
          rows_.middleCols<3>(3 * bone - 3));
  }

 private:
  const double* theta_;
  const Eigen::MatrixXd rows_;
};

class WindowIncrement : public WindowTerm {
 public:
  WindowIncrement(const WindowParts& parts, int t, const Frame& before, const Frame& after, int imu)
      : WindowTerm(parts, t - 1, 2, parts.problem.imu_bone[imu], 3),
        measured_(MeasuredRotation(before, imu).transpose() * MeasuredRotation(after, imu)) {}

 protected:
  void Compute(double* r, double** jacobians) const override {
    const M3 &before = Body(0).rotation[bone_], &after = Body(1).rotation[bone_];
    const double scale = 2.0 * std::sqrt(parts_.windows.increment);
    const M3 d = TurnError(before.transpose() * after, measured_, scale, after, r);
    if (!jacobians) return;
    AddTurn(jacobians, 0, M3(-d));
    AddTurn(jacobians, 1, d);
  }

 private:
  const M3 measured_;
};

class WindowForce : public WindowTerm {
 public:
  WindowForce(const WindowParts& parts, int first, int t, int imu)
      : WindowTerm(parts, t - 1, 3, parts.problem.imu_bone[imu], 3),
        offset_(parts.problem.imu_offset + 3 * imu),
        felt_(parts.windows.force(first + t, imu)) {
    parts.windows.Difference(first + t, c_);
  }

 protected:
  void Compute(double* r, double** jacobians) const override {
    V3 x[3], u(0, kGravity, 0);
    for (int k = 0; k < 3; ++k) {
      x[k] = Body(k).PointOf(bone_, offset_);
      u += c_[k] * x[k];
    }
    const M3 into_bone =
        std::sqrt(parts_.windows.specific_force) * Body(1).rotation[bone_].transpose();
    Eigen::Map<V3>(r, 3) =
        into_bone * u - std::sqrt(parts_.windows.specific_force) * V3(felt_);
    if (!jacobians) return;
    for (int k = 0; k < 3; ++k) AddPoint(jacobians, k, x[k], M3(c_[k] * into_bone));
    AddTurn(jacobians, 1, M3(into_bone * Cross(u)));
  }

 private:
  const double *offset_, *felt_;
  double c_[3];
};

// log(aᵀ b).
inline V3 LogBetween(const M3& a, const M3& b) {
  Eigen::Quaterniond q(M3(a.transpose() * b));
  if (q.w() < 0) q.coeffs() *= -1;
  const double sine = q.vec().norm();
  return (sine < 1e-8 ? 2.0 : 2.0 * std::atan2(sine, q.w()) / sine) * q.vec();
}

// J_l⁻¹(v).
inline M3 InverseLeft(const V3& v) {
  const double squared = v.squaredNorm(), half = 0.5 * std::sqrt(squared);
  const double c = squared < 1e-6 ? 1.0 / 12 + squared / 720
                                  : (1 - half * std::cos(half) / std::sin(half)) / squared;
  const M3 skew = Cross(v);
  return M3::Identity() - 0.5 * skew + c * skew * skew;
}

// Of a joint, or with a negative one of the root's place.
class WindowMotion : public WindowTerm {
 public:
  WindowMotion(const WindowParts& parts, const double* theta, int first, int t, int joint)
      : WindowTerm(parts, t - 1, 3, std::max(joint, 0), 3),
        theta_(theta + (t - 1) * parts.problem.pose),
        joint_(joint),
        scale_(std::sqrt(parts.windows.motion * parts.windows.steadiness[1 + joint])) {
    parts.windows.Difference(first + t, c_);
    for (double& c : c_) c *= scale_;
  }

 protected:
  void Compute(double* r, double** jacobians) const override {
    Eigen::Map<V3> residual(r, 3);
    if (joint_ < 0) {
      residual.setZero();
      for (int k = 0; k < 3; ++k) {
        residual += c_[k] * V3(theta_ + k * problem_.pose);
        if (jacobians) Add(jacobians, k, 0, 0, M3(c_[k] * M3::Identity()));
      }
      return;
    }
    const V3 before = LogBetween(Body(0).local[joint_], Body(1).local[joint_]);
    const V3 after = LogBetween(Body(1).local[joint_], Body(2).local[joint_]);
    residual = c_[2] * after - c_[0] * before;
    if (!jacobians) return;
    const M3 d[3] = {c_[0] * InverseLeft(before),
                     -c_[2] * InverseLeft(after) - c_[0] * InverseLeft(-before),
                     c_[2] * InverseLeft(-after)};
    for (int k = 0; k < 3; ++k)  // J_r(v) = J_l(v)ᵀ
      Add(jacobians, k, parts_.partition.block[joint_], 3 + 3 * joint_,
          M3(d[k] * Body(k).left[joint_].transpose()));
  }

 private:
  const double* theta_;
  const int joint_;
  const double scale_;
  double c_[3];
};

inline void BuildWindowAtBest(const WindowParts& parts, int first, double* theta,
                              ceres::Problem* built) {
  const Problem& problem = parts.problem;
  const int rank = problem.rank, rest = problem.angles - rank, length = parts.windows.length;
  const auto robust = [](double scale) { return new ceres::CauchyLoss(std::sqrt(scale)); };
  for (int t = 0; t < length; ++t) {
    const Frame frame = problem.frame(first + t);
    for (int k = 0; k < problem.landmarks; ++k) {
      auto* term = new WindowLandmark(parts, t, frame, k);
      if (term->Empty())
        delete term;
      else
        term->AddTo(built, theta, nullptr);
    }
    for (int bone : problem.floor_bone)
      (new WindowFloor(parts, t, bone))->AddTo(built, theta, nullptr);
    (new WindowPrior(parts, t, theta, 0, rest, problem.weights[3]))
        ->AddTo(built, theta, robust(1.0));
    (new WindowPrior(parts, t, theta, rest, rank, problem.weights[4]))
        ->AddTo(built, theta, robust(1.0));
    for (int imu = 0; imu < problem.imus; ++imu) {
      if (!std::isfinite(frame.imu_rotation[9 * imu])) continue;
      (new WindowOrientation(parts, t, frame, imu))->AddTo(built, theta, nullptr);
      if (t == 0) continue;
      const Frame before = problem.frame(first + t - 1);
      if (std::isfinite(before.imu_rotation[9 * imu]))
        (new WindowIncrement(parts, t, before, frame, imu))
            ->AddTo(built, theta, robust(kLossScale));
    }
    if (t == 0 || t + 1 == length) continue;
    for (int joint = -1; joint < problem.bones; ++joint)
      (new WindowMotion(parts, theta, first, t, joint))->AddTo(built, theta, robust(kLossScale));
    for (int imu = 0; imu < problem.imus; ++imu)
      if (std::isfinite(parts.windows.force(first + t, imu)[0]))
        (new WindowForce(parts, first, t, imu))->AddTo(built, theta, robust(kLossScale));
  }
}
