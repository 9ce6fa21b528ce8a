# The whole software on ROS 2 Jazzy:
#
#     docker build -t needle_steering .
#     docker run --rm --shm-size=1g -v "$PWD/bags:/needle_steering/bags" needle_steering scripts/simulate
#     docker run --rm --shm-size=1g --network=host -it needle_steering scripts/console
FROM ros:jazzy AS tools
RUN apt-get update \
    && apt-get install -y --no-install-recommends git python3-venv \
    && rm -rf /var/lib/apt/lists/*

FROM tools
WORKDIR /needle_steering
COPY . .
RUN bash -c "source /opt/ros/jazzy/setup.bash && scripts/setup --quiet"
# The image's entry point sources ROS.
CMD ["scripts/simulate"]
