"""What every room may use: checked settings, names of shipped files, secrets kept out of texts, intervals."""
