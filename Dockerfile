# The package on ROS 2 Jazzy, built; by default the demonstration runs.
#     docker build -t mr_damper_ros . && docker run --rm mr_damper_ros
FROM ros:jazzy
RUN apt-get update \
    && apt-get install -y --no-install-recommends build-essential cmake python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /mr_damper_ros
COPY . .
SHELL ["/bin/bash", "-c"]
RUN . /opt/ros/jazzy/setup.bash && make setup
CMD ["bash", "-c", ". /opt/ros/jazzy/setup.bash && make demo"]
