"""The Khepera Toolbox for Matlab by its own names."""
