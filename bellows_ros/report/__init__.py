"""Results as text: sentences by code, and the numbers and tables of the terminal and of pages."""
