"""Release, free flight and landing of the package, and the fit of the release."""
