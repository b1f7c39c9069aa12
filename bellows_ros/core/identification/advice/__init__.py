"""What recordings can tell, before and beside a fit."""
