"""The tables of the field: success and errors as PHC reports them, and model cards."""
