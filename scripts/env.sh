# Source this, in bash or zsh: the environment for `ros2 run`, Python and the tests.
#
#     source scripts/env.sh
#
# A ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE or FASTRTPS_DEFAULT_PROFILES_FILE that is already set
# stays as it is.
# shellcheck shell=bash

# Print list $2 (colons between its items) with item $1 first, and only once.
_needle_prepend() {
    local rest=":$2:"
    while [ "${rest#*":$1:"}" != "$rest" ]; do
        rest="${rest%%":$1:"*}:${rest#*":$1:"}"
    done
    rest="${rest#:}"
    rest="${rest%:}"
    printf '%s' "$1${rest:+:$rest}"
}

_needle_env() {
    [ -z "${ZSH_VERSION:-}" ] || emulate -L sh
    local root="$1" mode="" rest="" package="" profiles="" prefixes="${AMENT_PREFIX_PATH:-}"
    if [ -r "$root/.venv/.needle-setup" ]; then
        read -r mode rest <"$root/.venv/.needle-setup" || true
    fi
    if [ -z "$mode" ]; then
        echo "env.sh: this checkout is not set up, or only in part: run $root/scripts/setup" >&2
        return 1
    fi
    if [ "$mode" = apt ] && [ "${ROS_DISTRO:-}" != jazzy ]; then
        echo "env.sh: set up for ROS 2 Jazzy as installed: source its setup.bash first, or run $root/scripts/setup" >&2
        return 1
    fi
    if [ "$mode" = wheels ]; then
        if [ -n "${ROS_DISTRO:-}" ] && [ "${prefixes#*/opt/ros/}" != "$prefixes" ]; then
            echo "env.sh: set up for PyPI's wheels, but ROS 2 $ROS_DISTRO is sourced: run $root/scripts/setup, or use a new shell" >&2
            return 1
        fi
        # Libraries of another environment would be loaded in place of the wheels' own.
        unset LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
        # The message packages of the wheels are found in the environment itself.
        prefixes="$root/.venv"
    fi
    for package in "$root"/ros2_ws/install/*/share; do
        [ "$mode" = apt ] && [ -d "$package" ] || continue
        prefixes="$(_needle_prepend "${package%/share}" "$prefixes")"
    done
    unset PYTHONHOME
    export AMENT_PREFIX_PATH="$prefixes"
    export VIRTUAL_ENV="$root/.venv"
    PATH="$(_needle_prepend "$root/.venv/bin" "$PATH")"
    export PATH
    # Without it, an int in a float field is sent as garbage, silently.
    export ROS_PYTHON_CHECK_FIELDS=1
    # By default, no packet leaves or enters this machine.
    export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
    if [ "${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}" != rmw_fastrtps_cpp ]; then
        echo "env.sh: RMW_IMPLEMENTATION=$RMW_IMPLEMENTATION ignored: the rig's nodes run on rmw_fastrtps_cpp" >&2
    fi
    export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
    # Profile with shared memory for camera images and the discovery range; all nodes of the rig select it the same way.
    case "$ROS_AUTOMATIC_DISCOVERY_RANGE" in
        LOCALHOST | OFF) profiles=needle_fastdds.xml ;;
        *) profiles=needle_fastdds_network.xml ;;
    esac
    case "${FASTRTPS_DEFAULT_PROFILES_FILE:-}" in
        */needle_fastdds.xml | */needle_fastdds_network.xml) unset FASTRTPS_DEFAULT_PROFILES_FILE ;;
    esac
    if [ ! -f "${FASTRTPS_DEFAULT_PROFILES_FILE:-}" ]; then
        if [ -n "${FASTRTPS_DEFAULT_PROFILES_FILE:-}" ]; then
            echo "env.sh: FASTRTPS_DEFAULT_PROFILES_FILE=$FASTRTPS_DEFAULT_PROFILES_FILE ignored: no such file" >&2
        fi
        export FASTRTPS_DEFAULT_PROFILES_FILE="$root/ros2_ws/src/needle_core/needle_core/process/$profiles"
    fi
}

if [ -n "${BASH_VERSION:-}" ]; then
    _needle_file="${BASH_SOURCE[0]}"
elif [ -n "${ZSH_VERSION:-}" ]; then
    eval '_needle_file="${(%):-%x}"'
else
    _needle_file=""
fi
_needle_code=0
if [ -n "$_needle_file" ]; then
    _needle_env "$(CDPATH='' builtin cd -- "$(dirname -- "$_needle_file")/.." >/dev/null && pwd -P)" || _needle_code=$?
else
    echo "env.sh: only bash and zsh are supported" >&2
    _needle_code=1
fi
unset -f _needle_env _needle_prepend
unset _needle_file
if [ "$_needle_code" -ne 0 ]; then
    unset _needle_code
    # A shell that sources this file can return; a script that runs it must exit.
    return 1 2>/dev/null || exit 1
fi
unset _needle_code
