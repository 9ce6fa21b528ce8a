# Source this to get the workspace's environment: `source scripts/env.sh`.
unset LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
_needle_root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
. "$_needle_root/.venv/bin/activate"
export AMENT_PREFIX_PATH="$_needle_root/.venv"
. "$_needle_root/ros2_ws/install/setup.bash"
export ROS_PYTHON_CHECK_FIELDS=1
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
export FASTRTPS_DEFAULT_PROFILES_FILE="$_needle_root/ros2_ws/src/needle_bringup/config/fastdds.xml"
unset _needle_root
