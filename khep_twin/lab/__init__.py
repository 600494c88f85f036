"""The workbench: controllers and experiments on any port."""
