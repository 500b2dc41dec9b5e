"""What the commands of ``sb3-rpto`` do, one module each; :mod:`sb3_rpto.cli` lists them."""
