"""Prediction on samples outside a data set."""
