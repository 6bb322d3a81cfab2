# The environment that `make setup` built, for a bash or zsh shell, from any folder:
#     . ./env.bash

_mr_damper_env() {
  local root shell mode flags programs profiles foreign
  if [ -n "${BASH_VERSION:-}" ]; then
    shell=bash
    root=$(CDPATH="" cd -- "$(dirname -- "${BASH_SOURCE[0]}")" && pwd -P)
  elif [ -n "${ZSH_VERSION:-}" ]; then
    shell=zsh
    root=$1
  else
    echo "mr_damper_ros: env.bash is for bash and zsh." >&2
    return 1
  fi
  programs=$root/install/mr_damper_ros/lib/mr_damper_ros
  if [ ! -f "$root/.venv/stamp" ] || [ ! -f "$root/install/mr_damper_ros.stamp" ] \
    || [ ! -f "$root/install/mr_damper_msgs.stamp" ]; then
    echo "mr_damper_ros: nothing is built here: run \`make setup\` in $root first (in a workspace" \
      "colcon builds, and its install/setup.bash is sourced instead)." >&2
    return 1
  fi
  read -r mode _ <"$root/.venv/stamp"
  if [ "$mode" = wheels ] && [ -n "${ROS_DISTRO:-}" ]; then
    echo "mr_damper_ros: this was built without the ROS that is sourced here: run \`make setup\` in $root again." >&2
    return 1
  fi

  case ":$PATH:" in
    *":$root/.venv/bin:"*) ;;
    *) export PATH="$root/.venv/bin:$PATH" ;;
  esac
  export VIRTUAL_ENV="$root/.venv"
  flags=$-
  set +eu # the scripts of colcon are not written for these
  if [ "$mode" != jazzy ]; then
    unset AMENT_PREFIX_PATH # the path of another clone would be mixed with this
    foreign=$(printf '%s\n' "${PYTHONPATH:-}" | tr ':' '\n' | grep -v "^$root/" | tr '\n' ' ')
    case $foreign in
      *[!\ ]*) echo "mr_damper_ros: PYTHONPATH is set without ${foreign% }: modules there would" \
        "replace packages of this environment." >&2 ;;
    esac
    unset PYTHONPATH
  fi
  . "$root/install/setup.$shell"
  case $flags in *e*) set -e ;; esac
  case $flags in *u*) set -u ;; esac

  # No traffic with other machines by default.
  export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"

  # With this profile, restarted nodes are found at once; profiles of the user have priority.
  profiles=$root/install/mr_damper_ros/share/mr_damper_ros/config/fastdds.xml
  if [ -z "${FASTRTPS_DEFAULT_PROFILES_FILE:-}${FASTDDS_DEFAULT_PROFILES_FILE:-}" ] \
    && [ -f "$profiles" ]; then
    export FASTRTPS_DEFAULT_PROFILES_FILE="$profiles"
  fi

  # The wheels have no `ros2` command. So the programs can be called by their names, and a small
  # stand-in knows `ros2 run`.
  case "$(command -v ros2 || true)" in
    "" | "$root"/*)
      case ":$PATH:" in
        *":$programs:"*) ;;
        *) export PATH="$programs:$PATH:$root/scripts/bin" ;;
      esac
      ;;
  esac
}

if [ -n "${ZSH_VERSION:-}" ]; then
  eval '_mr_damper_env "${${(%):-%x}:A:h}"'
else
  _mr_damper_env
fi
