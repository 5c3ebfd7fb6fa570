"""The paper's studies: trials of filters and planners on the simulated truth, and their figures."""
