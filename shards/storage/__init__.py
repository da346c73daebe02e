"""The files below the rows: Parquet, PNG, OpenEXR."""
