"""Scripted missions: one YAML file is a flight, a demonstration and a test."""
