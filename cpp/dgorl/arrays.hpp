// Views of the caller's row-major arrays: one row per factor or pose.
#pragma once

#include <Eigen/Core>
#include <cstdint>

namespace dgorl {

template <int Columns>
using Rows = Eigen::Map<
    const Eigen::Matrix<double, Eigen::Dynamic, Columns, Columns == 1 ? Eigen::ColMajor : Eigen::RowMajor>>;
using Column = Rows<1>;
using Indices = Eigen::Map<const Eigen::Matrix<std::int64_t, Eigen::Dynamic, 1>>;
using Flags = Eigen::Map<const Eigen::Matrix<bool, Eigen::Dynamic, 1>>;
using Square = Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>;

}  // namespace dgorl
