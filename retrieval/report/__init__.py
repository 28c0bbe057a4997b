"""Results for people: a query's table and page, and the report of an evaluation."""

from retrieval.report.evaluation import write_report
from retrieval.report.query import print_table, query_html

__all__ = ["print_table", "query_html", "write_report"]
