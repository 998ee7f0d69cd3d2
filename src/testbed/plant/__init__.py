"""The plant: dynamics, sensor, actuator; the inputs."""
