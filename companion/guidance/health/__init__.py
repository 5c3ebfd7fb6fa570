"""Monitoring in flight: findings, autopilot health, contention, jumps and inputs."""
