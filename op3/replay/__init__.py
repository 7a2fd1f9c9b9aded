"""A log's commands through a model: windows from the measured state, free-run simulations, and their errors."""
