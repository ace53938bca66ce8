"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  const photos = byId("photos");
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
  const pager = photos.querySelector(".pager");
  let showView = () => {};
  if (pager) {
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
    showView = (number) => show(number - number % size);
    show(0);
  }

  const large = byId("large"), body = large.querySelector(".pictures");
  let number = 0, kind = 0;  // The view, and which of its pictures.
  const figureOf = (view) => views[view].querySelectorAll("figure")[kind];
  function enlarge(view) {
    number = view;
    const figure = figureOf(number), photo = views[number].querySelector(".photo");
    body.replaceChildren(...(figure === photo ? [photo] : [photo, figure]).map((source) => {
      const copy = document.createElement("figure");
      const image = source.querySelector("img").cloneNode();
      const caption = document.createElement("figcaption");
      caption.textContent = source.querySelector("figcaption").textContent;
      copy.append(image, caption);
      return copy;
    }));
    byId("large-title").textContent = views[number].querySelector("h3").textContent;
    large.querySelector("output").textContent = `${number + 1} of ${views.length}`;
    byId("large-back").disabled = number === 0;
    byId("large-ahead").disabled = number === views.length - 1;
  }
  const step = (by) => { if (views[number + by]) enlarge(number + by); };
  photos.addEventListener("click", (event) => {
    const figure = event.target.closest(".pictures figure");
    if (!figure) return;
    const view = figure.closest(".view");
    kind = [...view.querySelectorAll("figure")].indexOf(figure);
    enlarge(views.indexOf(view));
    large.showModal();
  });
  byId("large-back").addEventListener("click", () => step(-1));
  byId("large-ahead").addEventListener("click", () => step(1));
  byId("large-close").addEventListener("click", () => large.close());
  large.addEventListener("click", (event) => { if (event.target === large) large.close(); });
  large.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    event.preventDefault();
    step(by);
  });
  // The page shows the photo that was looked at last.
  large.addEventListener("close", () => {
    showView(number);
    figureOf(number).querySelector("button").focus();
  });
})();
