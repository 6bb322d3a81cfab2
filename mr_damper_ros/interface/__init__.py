"""What stands behind ``import mr_damper_ros as mr``: from files to parameters, errors, figures."""
