"""Stores of files in other layouts: public data sets, and HDF5 of the kinds that the field shares."""
