"""Recipes and evaluation on top of dptse_env."""
