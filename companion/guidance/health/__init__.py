"""What is watched in flight: findings, autopilot health, contention, jumps and inputs."""
