"""The method run over a collection: what is stored, what is done already, what is reported."""
