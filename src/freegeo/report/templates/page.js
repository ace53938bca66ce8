"use strict";
(() => {
  const photos = document.getElementById("photos");
  for (const input of photos.querySelectorAll("input")) {
    const apply = () => { if (input.checked) photos.dataset[input.name] = input.value; };
    input.addEventListener("change", apply);
    apply();
  }
  const sharpen = (image) => {
    if (image.naturalWidth && image.naturalWidth <= 160) image.classList.add("pixels");
  };
  for (const image of document.images) {
    if (image.complete) sharpen(image);
    else image.addEventListener("load", () => sharpen(image));
  }
  const views = [...photos.querySelectorAll(".view")];
  for (const pager of photos.querySelectorAll(".pager")) {
    const size = Number(pager.dataset.size), [back, ahead] = pager.querySelectorAll("button");
    let first = 0;
    const show = (place) => {
      first = place;
      views.forEach((view, k) => { view.hidden = k < first || k >= first + size; });
      const last = Math.min(first + size, views.length);
      pager.querySelector("output").textContent = `${first + 1} to ${last} of ${views.length}`;
      back.disabled = first === 0;
      ahead.disabled = last === views.length;
    };
    back.addEventListener("click", () => show(first - size));
    ahead.addEventListener("click", () => show(first + size));
    show(0);
  }
  const large = document.getElementById("large");
  const body = large.querySelector("div");
  photos.addEventListener("click", (event) => {
    const figure = event.target.closest(".pictures figure");
    if (!figure) return;
    const photo = figure.parentElement.querySelector(".photo");
    const shown = figure === photo ? [photo] : [photo, figure];
    body.replaceChildren(...shown.map((source) => {
      const copy = document.createElement("figure");
      const image = source.querySelector("img").cloneNode();
      const caption = document.createElement("figcaption");
      caption.textContent = image.alt;
      copy.append(image, caption);
      return copy;
    }));
    large.showModal();
  });
  large.addEventListener("click", (event) => {
    if (event.target === large || event.target.closest("button")) large.close();
  });
})();
