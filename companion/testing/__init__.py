"""For tests of users: a pytest plugin that flies missions (docs/missions.md).

The one part of `companion` that stands above the simulator; nothing else imports it.
"""
