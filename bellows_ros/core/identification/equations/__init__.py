"""The linear equations in K and P that both methods, advice and validation stand on."""
