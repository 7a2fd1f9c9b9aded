"""Common code of all subpackages: checked settings, names of shipped files, removal of secrets, intervals."""
