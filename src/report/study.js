'use strict';
(() => {
  const table = document.getElementById('study'), body = table.tBodies[0];
  const headings = [...table.tHead.rows[0].cells];
  const key = cell => (cell.dataset.key ?? cell.textContent).trim();
  const compare = (a, b) => {
    if (a === '' || b === '') return (a === '') - (b === '');
    const x = Number(a), y = Number(b);
    return Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b, undefined, { numeric: true }) : x - y;
  };
  headings.forEach((heading, column) => {
    const button = heading.querySelector('button');
    if (!button) return;
    button.addEventListener('click', () => {
      const down = heading.getAttribute('aria-sort') === 'ascending';
      headings.forEach(h => { if (h.hasAttribute('aria-sort')) h.setAttribute('aria-sort', 'none'); });
      heading.setAttribute('aria-sort', down ? 'descending' : 'ascending');
      const rows = [...body.rows].sort((a, b) => {
        const order = compare(key(a.cells[column]), key(b.cells[column]));
        return down ? -order : order;
      });
      body.append(...rows);
    });
  });
})();
