// The frozen fit of benches/fit.rs solved by Ceres: reads the problem that the bench writes, prints the least time of an
// iteration and the cost.
//
//   g++ -std=c++17 -O3 -march=native -DNDEBUG -I/usr/include/eigen3 fit_ceres.cpp -lceres -lglog -o fit_ceres
//   fit_ceres PROBLEM schur|normal
//
// Residuals, analytic Jacobians, priors and smoothness are those of src/fit/problem.rs, equation (1) there; the model is that of
// src/fit/state.rs and src/body/surface.rs. One residual block per frame, so that kinematics and twists are computed once a frame,
// and one dense row of Jacobian per point. Blocks: 8 numbers per frame (quaternion, position, phase) with 7 tangent directions, and all
// shared unknowns (weights, ln stature, lengths, widths) together.

#include <ceres/ceres.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <string>
#include <vector>

namespace {

constexpr int kNodes = 27;
constexpr int kLimbs = 10;
constexpr int kLocal = 7;
constexpr int kSamples = 100;
constexpr int kChannels = 84;
const double kSkin = std::sqrt(0.5 * std::log(2.0));
const double kDeep = 0.05;

using V3 = std::array<double, 3>;
using M3 = std::array<double, 9>;  // by rows

V3 operator+(const V3& a, const V3& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
V3 operator-(const V3& a, const V3& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
V3 operator*(const V3& a, double s) { return {a[0] * s, a[1] * s, a[2] * s}; }
double dot(const V3& a, const V3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
V3 cross(const V3& a, const V3& b) { return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}; }
V3 times(const M3& m, const V3& v) {
  return {m[0] * v[0] + m[1] * v[1] + m[2] * v[2], m[3] * v[0] + m[4] * v[1] + m[5] * v[2], m[6] * v[0] + m[7] * v[1] + m[8] * v[2]};
}
V3 transposed_times(const M3& m, const V3& v) {
  return {m[0] * v[0] + m[3] * v[1] + m[6] * v[2], m[1] * v[0] + m[4] * v[1] + m[7] * v[2], m[2] * v[0] + m[5] * v[1] + m[8] * v[2]};
}
M3 times(const M3& a, const M3& b) {
  M3 c{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) c[3 * i + j] += a[3 * i + k] * b[3 * k + j];
  return c;
}
M3 transposed(const M3& m) { return {m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]}; }
V3 column(const M3& m, int k) { return {m[k], m[3 + k], m[6 + k]}; }

/// I + a [v]x + b [v]x².
M3 polynomial(const V3& v, double a, double b) {
  const M3 hat = {0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0};
  const M3 square = times(hat, hat);
  M3 m = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  for (int i = 0; i < 9; ++i) m[i] += a * hat[i] + b * square[i];
  return m;
}
M3 exp_matrix(const V3& v) {
  const double n2 = dot(v, v), n = std::sqrt(n2);
  return n2 < 1e-16 ? polynomial(v, 1.0, 0.5) : polynomial(v, std::sin(n) / n, (1.0 - std::cos(n)) / n2);
}
M3 left_jacobian(const V3& v) {
  const double n2 = dot(v, v), n = std::sqrt(n2);
  if (n2 < 1e-8) return polynomial(v, 0.5 - n2 / 24.0, 1.0 / 6.0 - n2 / 120.0);
  return polynomial(v, (1.0 - std::cos(n)) / n2, (n - std::sin(n)) / (n2 * n));
}
M3 left_jacobian_inverse(const V3& v) {
  const double n2 = dot(v, v), n = std::sqrt(n2);
  return polynomial(v, -0.5, n2 < 1e-8 ? 1.0 / 12.0 + n2 / 720.0 : 1.0 / n2 - (1.0 + std::cos(n)) / (2.0 * n * std::sin(n)));
}

using Q = std::array<double, 4>;  // w x y z
Q times(const Q& a, const Q& b) {
  return {a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3], a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
          a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1], a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
}
Q exp_quaternion(const V3& v) {
  const double n = std::sqrt(dot(v, v)), s = n < 1e-8 ? 0.5 : std::sin(0.5 * n) / n;
  return {std::cos(0.5 * n), s * v[0], s * v[1], s * v[2]};
}
Q conjugated(const Q& q) { return {q[0], -q[1], -q[2], -q[3]}; }
V3 log_vector(Q q) {
  if (q[0] < 0.0) q = {-q[0], -q[1], -q[2], -q[3]};
  const V3 v = {q[1], q[2], q[3]};
  const double n = std::sqrt(dot(v, v));
  return v * (n < 1e-12 ? 2.0 : 2.0 * std::atan2(n, q[0]) / n);
}
M3 matrix(const Q& q) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  return {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
          2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
}

struct Primitive {
  int node, limb, axis;
  V3 centre, semi_axes;  // at stature 1
};
struct Point {
  V3 x;
  double offset_m, metres_per_root, root_weight;
  std::vector<int> near;
};
struct Frame {
  double time_s;
  std::vector<Point> points;
};

struct Data {
  int weights, shared;
  std::array<int, kNodes> parent, limb_above;
  std::array<V3, kNodes> offset;  // at stature 1
  std::array<double, kLimbs> hip;
  std::vector<Primitive> primitives;
  std::vector<double> functions;  // function, sample, channel
  std::array<Q, kNodes> mean;     // of nodes 1 to 26
  std::vector<double> eigenvalues;
  double tilt, acceleration, angular_acceleration, phase_acceleration, stature_sigma, width_sigma, known_stature;
  std::array<double, kLimbs> length_sigma;
  V3 up;
  std::vector<double> z;
  std::vector<std::array<double, 8>> carriers;
  std::vector<Frame> frames;

  int stature() const { return weights; }
  int length(int limb) const { return weights + 1 + limb; }
  int width(int limb) const { return weights + 1 + kLimbs + limb; }
};

class Reader {
 public:
  explicit Reader(const char* path) {
    std::ifstream file(path, std::ios::binary);
    std::vector<char> bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
    numbers_.resize(bytes.size() / sizeof(double));
    std::copy_n(bytes.data(), numbers_.size() * sizeof(double), reinterpret_cast<char*>(numbers_.data()));
  }
  double number() {
    if (at_ >= numbers_.size()) {
      std::fprintf(stderr, "the problem file is cut short\n");
      std::exit(1);
    }
    return numbers_[at_++];
  }
  int count() { return static_cast<int>(number()); }
  V3 vector() { return {number(), number(), number()}; }
  template <class T>
  void fill(T& into) {
    for (double& v : into) v = number();
  }

 private:
  std::vector<double> numbers_;
  size_t at_ = 0;
};

Data read(const char* path) {
  Reader r(path);
  Data d;
  const int frames = r.count();
  d.weights = r.count();
  d.shared = d.weights + 1 + 2 * kLimbs;
  for (int k = 0; k < kNodes; ++k) {
    d.parent[k] = r.count();
    d.limb_above[k] = r.count();
    d.offset[k] = r.vector();
  }
  r.fill(d.hip);
  d.primitives.resize(r.count());
  for (Primitive& p : d.primitives) {
    p.node = r.count();
    p.limb = r.count();
    p.axis = r.count();
    p.centre = r.vector();
    p.semi_axes = r.vector();
  }
  d.functions.resize((d.weights + 1) * kSamples * kChannels);
  r.fill(d.functions);
  for (int k = 1; k < kNodes; ++k) r.fill(d.mean[k]);
  d.eigenvalues.resize(d.weights);
  r.fill(d.eigenvalues);
  d.tilt = r.number();
  d.acceleration = r.number();
  d.angular_acceleration = r.number();
  d.phase_acceleration = r.number();
  d.stature_sigma = r.number();
  r.fill(d.length_sigma);
  d.width_sigma = r.number();
  d.up = r.vector();
  d.known_stature = r.number();
  d.z.resize(d.shared);
  r.fill(d.z);
  d.carriers.resize(frames);
  d.frames.resize(frames);
  for (int t = 0; t < frames; ++t) {
    d.frames[t].time_s = r.number();
    r.fill(d.carriers[t]);
    d.frames[t].points.resize(r.count());
    for (Point& p : d.frames[t].points) {
      p.x = r.vector();
      p.offset_m = r.number();
      p.metres_per_root = r.number();
      p.root_weight = std::sqrt(r.number());
      p.near.resize(r.count());
      for (int& i : p.near) i = r.count();
    }
  }
  return d;
}

struct Sample {
  std::array<double, kChannels> value, slope;
  std::vector<double> components;  // weight, channel
};

Sample sample(const Data& d, double phase, const double* z) {
  const double at = (phase - std::floor(phase)) * kSamples;
  const int first = static_cast<int>(at);
  const double u = at - first, u2 = u * u, u3 = u2 * u;
  const double w[4] = {0.5 * (-u3 + 2 * u2 - u), 0.5 * (3 * u3 - 5 * u2 + 2), 0.5 * (-3 * u3 + 4 * u2 + u), 0.5 * (u3 - u2)};
  const double s[4] = {0.5 * (-3 * u2 + 4 * u - 1), 0.5 * (9 * u2 - 10 * u), 0.5 * (-9 * u2 + 8 * u + 1), 0.5 * (3 * u2 - 2 * u)};
  Sample out;
  out.value.fill(0.0);
  out.slope.fill(0.0);
  out.components.assign(d.weights * kChannels, 0.0);
  for (int i = 0; i <= d.weights; ++i) {
    const double alpha = i == 0 ? 1.0 : z[i - 1];
    for (int k = 0; k < 4; ++k) {
      const double* f = &d.functions[(i * kSamples + (first + k - 1 + kSamples) % kSamples) * kChannels];
      for (int c = 0; c < kChannels; ++c) {
        out.value[c] += alpha * w[k] * f[c];
        out.slope[c] += alpha * s[k] * kSamples * f[c];
      }
      if (i > 0)
        for (int c = 0; c < kChannels; ++c) out.components[(i - 1) * kChannels + c] += w[k] * f[c];
    }
  }
  return out;
}

V3 triple(const double* channels, int k) { return {channels[3 * k], channels[3 * k + 1], channels[3 * k + 2]}; }

/// The posed body of one frame, and the twist of every node: six rows of `columns`.
struct Motion {
  std::array<M3, kNodes> axes;
  std::array<V3, kNodes> position;
  std::vector<double> twists;
  int columns;

  double* row(int node, int r) { return &twists[(node * 6 + r) * columns]; }
  void add_velocity(int node, int column, const V3& v) {
    for (int a = 0; a < 3; ++a) row(node, a)[column] += v[a];
  }
  void add_turn(int node, int column, const V3& omega, const V3& at) {
    add_velocity(node, column, cross(at, omega));
    for (int a = 0; a < 3; ++a) row(node, 3 + a)[column] += omega[a];
  }
  void add_spin(const Data& d, const Sample& s, int node, const M3& spin, int k) {
    add_turn(node, 6, times(spin, triple(s.slope.data(), k)), position[node]);
    for (int i = 0; i < d.weights; ++i)
      add_turn(node, kLocal + i, times(spin, triple(&s.components[i * kChannels], k)), position[node]);
  }
};

void pose(const Data& d, const double* carrier, const double* z, bool with_twists, Motion& m) {
  const Sample s = sample(d, carrier[7], z);
  const M3 world_from_carrier = matrix({carrier[0], carrier[1], carrier[2], carrier[3]});
  const V3 position = {carrier[4], carrier[5], carrier[6]};
  const double stature = std::exp(z[d.stature()]);
  double hip = 0.0;
  for (int l = 0; l < kLimbs; ++l) hip += stature * d.hip[l] * z[d.length(l)];
  const V3 tilt = triple(s.value.data(), kNodes - 1), ride = triple(s.value.data(), kNodes);
  m.columns = kLocal + d.shared;
  m.axes[0] = times(world_from_carrier, exp_matrix(tilt));
  m.position[0] = position + times(world_from_carrier, ride) * hip;
  if (with_twists) {
    m.twists.assign(kNodes * 6 * m.columns, 0.0);
    for (int a = 0; a < 3; ++a) {
      V3 unit{};
      unit[a] = 1.0;
      m.add_turn(0, a, unit, position);
      m.add_velocity(0, 3 + a, unit);
    }
    m.add_spin(d, s, 0, times(world_from_carrier, left_jacobian(tilt)), kNodes - 1);
    m.add_velocity(0, 6, times(world_from_carrier, triple(s.slope.data(), kNodes)) * hip);
    for (int i = 0; i < d.weights; ++i)
      m.add_velocity(0, kLocal + i, times(world_from_carrier, triple(&s.components[i * kChannels], kNodes)) * hip);
    for (int l = 0; l < kLimbs; ++l)
      if (d.hip[l] != 0.0) m.add_velocity(0, kLocal + d.length(l), times(world_from_carrier, ride) * (stature * d.hip[l]));
  }
  for (int k = 1; k < kNodes; ++k) {
    const int p = d.parent[k], limb = d.limb_above[k];
    const V3 coordinates = triple(s.value.data(), k - 1);
    const M3 world_from_mean = times(m.axes[p], matrix(d.mean[k]));
    const V3 stretch = times(m.axes[p], d.offset[k]) * stature;
    m.axes[k] = times(world_from_mean, exp_matrix(coordinates));
    m.position[k] = m.position[p] + stretch * z[d.length(limb)];
    if (with_twists) {
      std::copy_n(m.row(p, 0), 6 * m.columns, m.row(k, 0));
      m.add_spin(d, s, k, times(world_from_mean, left_jacobian(coordinates)), k - 1);
      m.add_velocity(k, kLocal + d.length(limb), stretch);
    }
  }
}

struct Posed {
  V3 centre, centre_in_node, semi_axes;
  M3 unit_from_world;
};

class Points : public ceres::CostFunction {
 public:
  Points(const Data& d, const Frame& frame) : d_(d), frame_(frame) {
    set_num_residuals(static_cast<int>(frame.points.size()));
    mutable_parameter_block_sizes()->push_back(8);
    mutable_parameter_block_sizes()->push_back(d.shared);
  }

  bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const override {
    const double *carrier = parameters[0], *z = parameters[1];
    Motion motion;
    pose(d_, carrier, z, jacobians != nullptr, motion);
    std::vector<Posed> posed(d_.primitives.size());
    place(motion, z, posed);
    const V3 root = {carrier[4], carrier[5], carrier[6]};
    std::vector<double> row(kLocal + d_.shared);
    for (size_t i = 0; i < frame_.points.size(); ++i) {
      const Point& point = frame_.points[i];
      V3 unit[16], force[16];
      double nearest = INFINITY, distance[16];
      const size_t count = point.near.size();
      for (size_t k = 0; k < count; ++k) {
        const Posed& p = posed[point.near[k]];
        unit[k] = times(p.unit_from_world, point.x - p.centre);
        distance[k] = dot(unit[k], unit[k]);
        nearest = std::min(nearest, distance[k]);
      }
      double sum = 0.0;
      for (size_t k = 0; k < count; ++k) {
        const double weight = std::exp(-2.0 * (distance[k] - nearest));
        sum += weight;
        if (jacobians) force[k] = transposed_times(posed[point.near[k]].unit_from_world, unit[k]) * (2.0 * weight);
      }
      const double d_eff = nearest - 0.5 * std::log(sum), shallow = std::sqrt(std::max(d_eff, kDeep)), slope = 0.5 / shallow;
      const double value = shallow + (d_eff - std::max(d_eff, kDeep)) * slope;
      const double scale = point.root_weight * point.metres_per_root;
      residuals[i] = point.root_weight * point.offset_m + scale * (value - kSkin);
      if (!jacobians) continue;
      for (size_t k = 0; k < count; ++k) force[k] = force[k] * (-scale * slope / sum);
      jacobian_row(motion, posed, point, unit, force, root, z, row);
      if (jacobians[0]) {
        std::copy_n(row.data(), kLocal, jacobians[0] + 8 * i);
        jacobians[0][8 * i + 7] = 0.0;
      }
      if (jacobians[1]) std::copy_n(row.data() + kLocal, d_.shared, jacobians[1] + d_.shared * i);
    }
    return true;
  }

 private:
  void place(const Motion& motion, const double* z, std::vector<Posed>& posed) const {
    const double stature = std::exp(z[d_.stature()]);
    for (size_t i = 0; i < posed.size(); ++i) {
      const Primitive& p = d_.primitives[i];
      const double length = stature * z[d_.length(p.limb)], width = stature * z[d_.width(p.limb)];
      Posed& q = posed[i];
      q.centre_in_node = p.centre * length;
      for (int a = 0; a < 3; ++a) q.semi_axes[a] = p.semi_axes[a] * (a == p.axis ? length : width);
      q.centre = motion.position[p.node] + times(motion.axes[p.node], q.centre_in_node);
      q.unit_from_world = transposed(motion.axes[p.node]);
      for (int e = 0; e < 9; ++e) q.unit_from_world[e] /= q.semi_axes[e / 3];
    }
  }

  /// Wrenches of the point's few nodes times their twists, and what sizes deform.
  void jacobian_row(Motion& motion, const std::vector<Posed>& posed, const Point& point, const V3* unit, const V3* force, const V3& root,
                    const double* z, std::vector<double>& row) const {
    std::fill(row.begin(), row.end(), 0.0);
    double* shared = row.data() + kLocal;
    int nodes[16], met = 0;
    V3 on_node[16], total{};
    for (size_t k = 0; k < point.near.size(); ++k) {
      const Primitive& p = d_.primitives[point.near[k]];
      const Posed& q = posed[point.near[k]];
      const int at = static_cast<int>(std::find(nodes, nodes + met, p.node) - nodes);
      if (at == met) {
        nodes[met] = p.node;
        on_node[met++] = V3{};
      }
      on_node[at] = on_node[at] + force[k];
      total = total + force[k];
      V3 lengthened = q.centre_in_node, widened{};
      for (int a = 0; a < 3; ++a) (a == p.axis ? lengthened : widened)[a] += q.semi_axes[a] * unit[k][a];
      const V3 in_node = transposed_times(motion.axes[p.node], force[k]);
      shared[d_.length(p.limb)] += dot(in_node, lengthened) / z[d_.length(p.limb)];
      shared[d_.width(p.limb)] += dot(in_node, widened) / z[d_.width(p.limb)];
    }
    shared[d_.stature()] += dot(total, point.x - root);
    for (int n = 0; n < met; ++n) {
      const V3 moment = cross(point.x, on_node[n]);
      for (int r = 0; r < 6; ++r) {
        const double w = r < 3 ? on_node[n][r] : moment[r - 3];
        const double* twist = motion.row(nodes[n], r);
        for (size_t c = 0; c < row.size(); ++c) row[c] += w * twist[c];
      }
    }
  }

  const Data& d_;
  const Frame& frame_;
};

/// Accelerations of position, phase and rotation over three frames.
class Steady : public ceres::SizedCostFunction<7, 8, 8, 8> {
 public:
  Steady(const Data& d, int t) : d_(d) {
    const double before = d.frames[t].time_s - d.frames[t - 1].time_s, after = d.frames[t + 1].time_s - d.frames[t].time_s;
    const double mid = 0.5 * (before + after);
    p_ = 1.0 / (before * mid);
    n_ = 1.0 / (after * mid);
  }

  bool Evaluate(double const* const* c, double* residuals, double** jacobians) const override {
    const double stencil[3] = {p_, -(p_ + n_), n_};
    for (int a = 0; a < 4; ++a) {
      const double sigma = a < 3 ? d_.acceleration : d_.phase_acceleration;
      residuals[a] = 0.0;
      for (int f = 0; f < 3; ++f) residuals[a] += stencil[f] * c[f][4 + a] / sigma;
    }
    const Q now = conjugated({c[1][0], c[1][1], c[1][2], c[1][3]});
    const V3 to_next = log_vector(times(Q{c[2][0], c[2][1], c[2][2], c[2][3]}, now));
    const V3 to_previous = log_vector(times(Q{c[0][0], c[0][1], c[0][2], c[0][3]}, now));
    const double sigma = d_.angular_acceleration;
    for (int a = 0; a < 3; ++a) residuals[4 + a] = (n_ * to_next[a] + p_ * to_previous[a]) / sigma;
    if (!jacobians) return true;
    const M3 of[3] = {left_jacobian_inverse(to_previous), left_jacobian_inverse(to_next * -1.0), left_jacobian_inverse(to_next)};
    const M3 other = left_jacobian_inverse(to_previous * -1.0);
    for (int f = 0; f < 3; ++f) {
      if (!jacobians[f]) continue;
      std::fill_n(jacobians[f], 7 * 8, 0.0);
      for (int a = 0; a < 4; ++a) jacobians[f][8 * a + 3 + a] = stencil[f] / (a < 3 ? d_.acceleration : d_.phase_acceleration);
      for (int e = 0; e < 9; ++e)
        jacobians[f][8 * (4 + e / 3) + e % 3] = (f == 0 ? p_ * of[0][e] : f == 2 ? n_ * of[2][e] : -n_ * of[1][e] - p_ * other[e]) / sigma;
    }
    return true;
  }

 private:
  const Data& d_;
  double p_, n_;
};

/// Lean of the carrier.
class Upright : public ceres::SizedCostFunction<2, 8> {
 public:
  explicit Upright(const Data& d) : d_(d), sigma_(d.tilt * std::sqrt(static_cast<double>(d.frames.size()))) {}

  bool Evaluate(double const* const* c, double* residuals, double** jacobians) const override {
    const M3 carrier_from_world = transposed(matrix({c[0][0], c[0][1], c[0][2], c[0][3]}));
    const V3 up = times(carrier_from_world, d_.up);
    const M3 hat = {0, -d_.up[2], d_.up[1], d_.up[2], 0, -d_.up[0], -d_.up[1], d_.up[0], 0};
    const M3 slope = times(carrier_from_world, hat);
    for (int i = 0; i < 2; ++i) {
      residuals[i] = up[2 * i] / sigma_;
      if (!jacobians || !jacobians[0]) continue;
      std::fill_n(jacobians[0] + 8 * i, 8, 0.0);
      for (int a = 0; a < 3; ++a) jacobians[0][8 * i + a] = slope[3 * (2 * i) + a] / sigma_;
    }
    return true;
  }

 private:
  const Data& d_;
  double sigma_;
};

/// Weights, stature, lengths and widths.
class Prior : public ceres::CostFunction {
 public:
  explicit Prior(const Data& d) : mean_(d.shared, 0.0), sigma_(d.shared, 0.0) {
    set_num_residuals(d.shared);
    mutable_parameter_block_sizes()->push_back(d.shared);
    for (int i = 0; i < d.weights; ++i) sigma_[i] = std::sqrt(d.eigenvalues[i]);
    mean_[d.stature()] = std::log(d.known_stature);
    sigma_[d.stature()] = d.stature_sigma;
    for (int l = 0; l < kLimbs; ++l) {
      mean_[d.length(l)] = mean_[d.width(l)] = 1.0;
      sigma_[d.length(l)] = d.length_sigma[l];
      sigma_[d.width(l)] = d.width_sigma;
    }
  }

  bool Evaluate(double const* const* z, double* residuals, double** jacobians) const override {
    const size_t n = mean_.size();
    if (jacobians && jacobians[0]) std::fill_n(jacobians[0], n * n, 0.0);
    for (size_t i = 0; i < n; ++i) {
      residuals[i] = (z[0][i] - mean_[i]) / sigma_[i];
      if (jacobians && jacobians[0]) jacobians[0][i * n + i] = 1.0 / sigma_[i];
    }
    return true;
  }

 private:
  std::vector<double> mean_, sigma_;
};

/// Left perturbation of the rotation, then position and phase. Jacobians above are already those of the tangent in their first seven
/// columns, so that of Plus is the identity over a row of zeros.
class Carrier : public ceres::Manifold {
 public:
  int AmbientSize() const override { return 8; }
  int TangentSize() const override { return kLocal; }
  bool Plus(const double* x, const double* delta, double* sum) const override {
    Q q = times(exp_quaternion({delta[0], delta[1], delta[2]}), Q{x[0], x[1], x[2], x[3]});
    const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; ++i) sum[i] = q[i] / norm;
    for (int i = 0; i < 4; ++i) sum[4 + i] = x[4 + i] + delta[3 + i];
    return true;
  }
  bool PlusJacobian(const double*, double* jacobian) const override {
    for (int i = 0; i < 8 * kLocal; ++i) jacobian[i] = i / kLocal == i % kLocal ? 1.0 : 0.0;
    return true;
  }
  bool Minus(const double* y, const double* x, double* difference) const override {
    const V3 turn = log_vector(times(Q{y[0], y[1], y[2], y[3]}, conjugated({x[0], x[1], x[2], x[3]})));
    for (int i = 0; i < 3; ++i) difference[i] = turn[i];
    for (int i = 0; i < 4; ++i) difference[3 + i] = y[4 + i] - x[4 + i];
    return true;
  }
  bool MinusJacobian(const double*, double* jacobian) const override {
    for (int i = 0; i < 8 * kLocal; ++i) jacobian[i] = i / 8 == i % 8 ? 1.0 : 0.0;
    return true;
  }
};

}  // namespace

int main(int argc, char** argv) {
  if (argc != 3) {
    std::fprintf(stderr, "usage: fit_ceres PROBLEM schur|normal\n");
    return 2;
  }
  google::InitGoogleLogging(argv[0]);
  Data d = read(argv[1]);
  ceres::Problem problem;
  for (auto& carrier : d.carriers) problem.AddParameterBlock(carrier.data(), 8, new Carrier);
  problem.AddParameterBlock(d.z.data(), d.shared);
  for (size_t t = 0; t < d.frames.size(); ++t) {
    problem.AddResidualBlock(new Points(d, d.frames[t]), nullptr, d.carriers[t].data(), d.z.data());
    problem.AddResidualBlock(new Upright(d), nullptr, d.carriers[t].data());
    if (t > 0 && t + 1 < d.frames.size())
      problem.AddResidualBlock(new Steady(d, static_cast<int>(t)), nullptr, d.carriers[t - 1].data(), d.carriers[t].data(),
                               d.carriers[t + 1].data());
  }
  problem.AddResidualBlock(new Prior(d), nullptr, d.z.data());

  ceres::Solver::Options options;
  options.linear_solver_type = std::string(argv[2]) == "schur" ? ceres::SPARSE_SCHUR : ceres::SPARSE_NORMAL_CHOLESKY;
  options.num_threads = 1;
  options.max_num_iterations = 200;
  options.function_tolerance = 1e-13;
  options.gradient_tolerance = 0.0;
  options.parameter_tolerance = 0.0;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);

  double least = INFINITY;
  for (const auto& it : summary.iterations)
    if (it.iteration > 0 && it.step_is_successful) least = std::min(least, it.iteration_time_in_seconds);
  std::printf("iterations %zu\ninitial_cost %.17g\nfinal_cost %.17g\nseconds %.9g\n", summary.iterations.size() - 1, summary.initial_cost,
              summary.final_cost, least);
  return summary.IsSolutionUsable() ? 0 : 1;
}
