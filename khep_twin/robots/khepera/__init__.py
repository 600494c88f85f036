"""The Khepera and the Khepera II."""
