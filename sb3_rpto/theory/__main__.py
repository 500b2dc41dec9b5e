"""``python -m sb3_rpto.theory`` prints the table."""

from sb3_rpto.theory.table import main

if __name__ == "__main__":
    main()
